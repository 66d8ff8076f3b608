"""``sb3-sap demo --task racing``: learn to race from a scripted driver's log, then drive a lap beside the driver's."""

from __future__ import annotations

import inspect
import json
import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.benchmark.task_settings import guided_algorithms, task_settings
from sb3_sap.common.files import atomic_path
from sb3_sap.envs.torcs.scripted import ScriptedDriver
from sb3_sap.evaluation.plots import save
from sb3_sap.evaluation.racing import RACING, RaceLap, lap_figure, race

#: Steps that the scripted driver logs, and the longest drive from one of its starts.
LOGGED, DRIVE = 6_000, 600
#: Standard deviations of the noise on its steering and pedal, of which one is drawn for each drive. A faultless log
#: would say nothing of mistakes, nor of what to do after one.
NOISE = (0.05, 0.4)
#: Gradient steps of the actor that imitates the log's permissible actions.
TAUGHT = 3_000
#: Entropy coefficient to begin with: a policy that knows something needs little.
ENT_COEF = "auto_0.05"


@dataclass
class RacingRun:
    """Settings of a demonstration of racing."""

    algo: str = "tqc_ap"
    steps: int = 0  # after the imitation
    seed: int = 0
    track: str = "g-track-3"
    out: Path = field(default_factory=lambda: Path("demo_output"))

    @property
    def command(self) -> str:
        """The command that does the same again."""
        names = ("algo", "steps", "seed", "track") if self.steps else ("algo", "seed", "track")
        given = [word for name in names for word in (f"--{name}", str(getattr(self, name)))]
        return shlex.join(["sb3-sap", "demo", "--task", "racing", *given])


def racing_demo(run: RacingRun, console: Console) -> dict[str, RaceLap]:
    """Learns, drives a lap, and leaves model, tables and a picture in ``run.out``.

    :raise ValueError: for an algorithm without settings for racing
    """
    if run.algo not in guided_algorithms(RACING):
        raise ValueError(f"`--task racing` trains {' or '.join(guided_algorithms(RACING))}, got {run.algo!r}.")
    env = gym.make(RACING, track=run.track, random_start=True)
    algorithm = ALGORITHMS[run.algo]
    settings = task_settings(run.algo, "task", RACING, set(inspect.signature(algorithm).parameters))
    settings |= {"learning_starts": 0, "ent_coef": ENT_COEF}
    model: Any = algorithm("MlpPolicy", env, seed=run.seed, **settings)
    driver = ScriptedDriver()
    console.print(f"A scripted driver logs {LOGGED:,} steps on {run.track}")
    console.print(str(model.add_knowledge(log(driver, run.track, run.seed))))
    console.print(str(model.fit_predictor()))
    console.print(f"[bold]{algorithm.__name__}[/] imitates what was permissible")
    model.teach_policy(TAUGHT, hold=run.steps // 2)
    laps = {algorithm.__name__: race(model, run.track), "scripted": race(driver, run.track)}
    if run.steps:
        console.print(f"It learns for {run.steps:,} steps, the first half of them with the policy as it is")
        model.learn(run.steps, progress_bar=console.is_terminal)
        laps = {f"{algorithm.__name__} after {run.steps:,} steps": race(model, run.track), **laps}
    with atomic_path(run.out / "model.zip") as temporary:
        model.save(temporary)
    model.save_predictor(run.out / "predictor.pt")
    with atomic_path(run.out / "run.json") as temporary:
        described = {**asdict(run), "out": str(run.out), "command": run.command}
        temporary.write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
    table = pd.concat([lap.steps.assign(driver=name) for name, lap in laps.items()])
    with atomic_path(run.out / "laps.csv") as temporary:
        table.round(4).to_csv(temporary, index=False)
    save(lap_figure(laps), run.out / "lap.png")
    console.print(laps_table(laps))
    console.print(f"Model, laps and picture are in [bold]{run.out}/[/]")
    return laps


def log(driver: ScriptedDriver, track: str, seed: int) -> dict[str, np.ndarray[Any, Any]]:
    """Transitions of the driver with noise on its actions, from starts all over the track."""
    env = gym.make(RACING, track=track, random_start=True, laps=None)
    rng = np.random.default_rng(seed)
    names = ("obs", "actions", "next_obs", "rewards", "dones", "truncated")
    rows = []
    obs, _ = env.reset(seed=seed)
    noise, driven = rng.choice(NOISE), 0
    for _ in range(LOGGED):
        action = np.clip(driver.predict(obs)[0] + rng.normal(0, noise, 2), -1, 1).astype(np.float32)
        next_obs, reward, terminated, _, _ = env.step(action)
        driven += 1
        over = terminated or driven == DRIVE
        rows.append((obs, action, next_obs, reward, over, over and not terminated))
        obs = next_obs
        if over:
            obs, _ = env.reset()
            noise, driven = rng.choice(NOISE), 0
    env.close()
    return {name: np.array(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}


def laps_table(laps: dict[str, RaceLap]) -> Table:
    """Lap times and speeds."""
    table = Table(title="One lap from a standing start")
    for name in ("driver", "lap time", "covered", "mean speed"):
        table.add_column(name, justify="left" if name == "driver" else "right")
    for name, lap in laps.items():
        time = "" if lap.lap_time is None else f"{lap.lap_time:.2f} s"
        table.add_row(name, time, f"{lap.covered:.1%}", f"{lap.mean_speed:.1f} km/h")
    return table
