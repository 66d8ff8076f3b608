"""The page of racing: which tracks are lapped from the grid, after how many steps, and in what time."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sap.benchmark.reports.drawing import line_figure
from sb3_sap.benchmark.reports.measures import LOST, median_reached, ms_per_step
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.benchmark.reports.ways import run_scores
from sb3_sap.evaluation.statistics import bootstrap_interval, interquartile_mean

#: Tracks beside the first that a driver who has learned to race laps.
UNSEEN = 2
#: Shares of the shortest training after which the part of a lap is told.
SHARES = (0.25, 0.5)
NOTE = (
    "All configurations of an algorithm share its base settings. `penalty=0` is the base algorithm. Each evaluation is "
    "one lap of each track from the grid, at rest, with the actor alone. *Part of a lap* is the mean over the tracks "
    "(without Spring, whose long lap is driven at the end only), as the interquartile mean over seeds with its 95 % "
    "bootstrap interval, at the last evaluation until then. *Steps until the goal* ({goal}) are medians over seeds, in "
    "which a run that never gets there counts as infinite, and the number of seeds that do is in brackets. A track's "
    "column has the number of runs that lap it at the end, and the median of their lap times. *Mistakes* is the share "
    "of all training steps with a non-permissible part. Milliseconds per step are processor time.\n"
)


def races(results: Results, folder: Path, command: str) -> None:
    """Writes ``races.md``, ``races.svg``, and ``races.csv`` with a row for every lap."""
    write_csv(folder / "races.csv", results.laps.drop(columns="score"))
    scores = run_scores(results)
    learners = [configuration.name for configuration in results.configurations if configuration.learns]
    if learners:
        figure = line_figure(scores, learners, "checkpoint", "score", "training step", "part of a lap")
        write_figure(folder / "races.svg", figure)
    shortest = min((scores[scores["configuration"] == name]["checkpoint"].max() for name in learners), default=0)
    rows = [_row(results, scores, name, [share * shortest for share in SHARES]) for name in results.names]
    parts = ["![Part of a lap over training steps](races.svg)\n"] if learners else []
    table = pd.DataFrame(rows).fillna("")
    first, *others = results.laps["track"].unique()
    goal = f"laps of {first} and of {UNSEEN} other tracks in one evaluation"
    note = NOTE.format(goal=goal if len(others) >= UNSEEN else f"a lap of {first}")
    write_page(folder / "races.md", "Racing", [*parts, markdown(table), note], results, command)


def steps_to_laps(laps: pd.DataFrame) -> pd.Series:
    """The first checkpoint at which the first track and `UNSEEN` others are lapped, else infinity.

    Where fewer tracks are driven, the first alone counts. The series is indexed by configuration and seed.
    """
    first, *others = laps["track"].unique()
    done = laps.assign(done=laps["lap_done"].astype(bool), own=laps["track"] == first)
    lapped = done.groupby(["configuration", "seed", "checkpoint", "own"])["done"].sum().unstack(fill_value=0)
    good = lapped[True] > 0
    if len(others) >= UNSEEN:
        good &= lapped[False] >= UNSEEN
    good = good.rename("good").reset_index()
    reached = good["checkpoint"].where(good["good"], math.inf)
    return reached.groupby([good["configuration"], good["seed"]]).min()


def _row(results: Results, scores: pd.DataFrame, name: str, points: list[float]) -> dict[str, str]:
    own = scores[scores["configuration"] == name]
    laps = results.laps[results.laps["configuration"] == name]
    last = laps["checkpoint"].max()
    row = {"configuration": name, "seeds": str(own["seed"].nunique())}
    if last > 0:
        row["steps"] = f"{last:,}"
        for title, point in [*((f"after {point:,.0f}", point) for point in points), ("at the end", last)]:
            at = own["checkpoint"][own["checkpoint"] <= point].max()
            values = own[own["checkpoint"] == at]["score"].to_numpy()[:, None]
            if len(values):
                low, high = bootstrap_interval(values)
                row[f"part of a lap {title}"] = f"{interquartile_mean(values):.2f} [{low:.2f}, {high:.2f}]"
        median, number = median_reached(steps_to_laps(laps))
        row["steps until the goal"] = f"{median:,.0f} ({number})" if math.isfinite(median) else f"– ({number})"
    final = laps[laps["checkpoint"] == last]
    for track, at_the_end in final.groupby("track", sort=False):
        times = at_the_end["lap_time"].dropna().astype(float)
        row[str(track)] = f"{len(times)} of {len(at_the_end)}" + (f", {times.median():.1f} s" if len(times) else "")
    if last > 0:
        curve = results.curve[results.curve["configuration"] == name]
        ends = curve.sort_values("step").groupby("seed").last()
        row["mistakes"] = f"{float((ends['mistakes'].astype(float) / ends['step']).median()):.1%}"
        ended = results.episodes[results.episodes["configuration"] == name]
        lost = ended[ended["ended"].isin(LOST)].groupby("seed").size().reindex(own["seed"].unique(), fill_value=0)
        row["episodes lost"] = f"{lost.median():g}"
        milliseconds = ms_per_step(results.times[results.times["configuration"] == name]).median()
        row["ms per step"] = "" if np.isnan(milliseconds) else f"{milliseconds:.1f}"
    return row
