"""Measures the scripted driver of sap/TorcsRacing-v0: its lap times, and the share of its actions that the AP functions
of steering and pedal refuse, beside that of the same driver with random steering or a random pedal.

The first lap begins at rest, and is counted from there; the second is a flying one.

python measurements/racing_laps.py [--out results/racing_laps.csv]   # writes .csv and .md
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

import sb3_sap  # noqa: F401  # registers the environment
from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text
from sb3_sap.envs.torcs.scripted import DECELERATION, ScriptedDriver
from sb3_sap.envs.tracks import TRACKS
from sb3_sap.envs.units import KMH
from sb3_sap.tasks import RACING_PARTS, racing

#: Decelerations of the driver, m/s²: its default, and one with which it is faster.
DECELERATIONS = (DECELERATION, 12.0)
LAPS = 2
#: Tables of the page, by their column of the data.
TABLES = {
    "lap_2_s": "The second lap, flying, s",
    "lap_1_s": "The first lap, from rest, s",
    "lap_1_kmh": "Its mean speed, km/h",
    "steering_refused_pct": "Actions whose steering is refused, %",
    "pedal_refused_pct": "Actions whose pedal is refused, %",
}
RANDOM_STEPS = 2_000


def refused(transitions: list[Any]) -> dict[str, float]:
    """Percentages of the actions that the AP functions refuse."""
    labels = racing(*(np.array(part) for part in zip(*transitions, strict=True)))
    steering, pedal = 100 * (1 - labels.mean(axis=0))
    return {"steering_refused_pct": round(steering, 1), "pedal_refused_pct": round(pedal, 1)}


def drive(track: str, deceleration: float) -> dict[str, Any]:
    """Drives `LAPS` laps from the grid."""
    env = gym.make("sap/TorcsRacing-v0", track=track, laps=LAPS, max_episode_steps=30_000)
    driver, transitions, over = ScriptedDriver(deceleration), [], False
    obs, info = env.reset(seed=0)
    while not over:
        action, _ = driver.predict(obs)
        next_obs, _, terminated, truncated, info = env.step(action)
        transitions.append((obs, action, next_obs))
        obs, over = next_obs, terminated or truncated
    times = [*info["lap_times"], *[np.nan] * LAPS][:LAPS]
    length = env.get_wrapper_attr("length")
    speeds = {f"lap_{i}_kmh": round(length / time * KMH, 1) for i, time in enumerate(times, 1)}
    laps = {f"lap_{i}_s": round(time, 2) for i, time in enumerate(times, 1)}
    env.close()
    return {"track": track, "driver": f"scripted, {deceleration:g} m/s²", **laps, **speeds, **refused(transitions)}


def random_parts(track: str, part: int) -> dict[str, Any]:
    """The driver with one part of its actions uniformly random, in episodes that start anywhere."""
    env = gym.make("sap/TorcsRacing-v0", track=track, random_start=True)
    rng, driver, transitions = np.random.default_rng(0), ScriptedDriver(), []
    obs, _ = env.reset(seed=0)
    for _ in range(RANDOM_STEPS):
        action, _ = driver.predict(obs)
        action[part] = rng.uniform(-1, 1)
        next_obs, _, terminated, truncated, _ = env.step(action)
        transitions.append((obs, action, next_obs))
        obs = env.reset()[0] if terminated or truncated else next_obs
    env.close()
    return {"track": track, "driver": f"scripted, random {list(RACING_PARTS)[part]}", **refused(transitions)}


def main(out: Path) -> None:
    """Drives every track and writes the rows, then the table."""
    rows = []
    for track in TRACKS:
        rows += [drive(track, deceleration) for deceleration in DECELERATIONS] + [
            random_parts(track, part) for part in range(len(RACING_PARTS))
        ]
        print(pd.DataFrame(rows).tail(4).to_string(header=len(rows) == 4), flush=True)
        write_csv(out, pd.DataFrame(rows))
    made = provenance()
    text = "# The scripted driver of sap/TorcsRacing-v0\n\n" + "\n".join(
        f"{title}:\n\n{markdown(wide(pd.DataFrame(rows), column))}" for column, title in TABLES.items()
    )
    text += f"\nMade by `python measurements/racing_laps.py` on {made['date']}, revision {made['revision']}.\n"
    write_text(out.with_suffix(".md"), text)


def wide(table: pd.DataFrame, column: str) -> pd.DataFrame:
    """A row for each driver, a column for each track; drivers without values are left out."""
    values = table.pivot(index="driver", columns="track", values=column)[list(TRACKS)].dropna(how="all")
    return values.map(lambda value: f"{value:.1f}").reset_index()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/racing_laps.csv"))
    main(parser.parse_args().out)
