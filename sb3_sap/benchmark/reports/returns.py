"""The page of a task beyond lane keeping: learning curves and a table of returns."""

from __future__ import annotations

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_sap.benchmark.drawing import line_figure
from sb3_sap.benchmark.measures import median_reached, ms_per_step
from sb3_sap.benchmark.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.results import Results
from sb3_sap.evaluation import find_environment
from sb3_sap.permissibility import FloatArray
from sb3_sap.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement

NOTE = (
    "A run's return is the mean over its evaluation episodes, whose seeds are the same for every run, of the actor "
    "alone. Of the runs stands the interquartile mean with its 95 % bootstrap interval. *Permissible* is the share of "
    "the actor's actions in the last evaluation that the task's AP function does not call a mistake: what a policy "
    "that has learned the task is refused by it shows how far it is from being sound. A step's milliseconds are those "
    "of the processor.\n"
)


def returns(results: Results, folder: Path, command: str) -> None:
    """Writes ``returns.md``, its picture, ``returns.csv`` of all episodes and ``returns_improvement.csv``."""
    write_csv(folder / "returns.csv", results.laps.drop(columns="score").rename(columns={"track": "episode"}))
    runs = mean_returns(results.laps)
    write_figure(folder / "returns", _figure(runs, results))
    find_environment(results.simulator)
    spec = gym.spec(results.simulator)
    table = pd.DataFrame([_row(results, runs, name, spec.reward_threshold) for name in results.names])
    improvements = improvement(runs, results)
    write_csv(folder / "returns_improvement.csv", improvements.round(6))
    told = [f"{p:.2f} [{low:.2f}, {high:.2f}]" for p, low, high in improvements.iloc[:, 2:].to_numpy()]
    parts = ["![Returns](returns.svg)\n", markdown(table), NOTE]
    if told:
        better = improvements.iloc[:, :2].assign(**{"probability of improvement": told})
        parts += ["## How probably a guided run ends with the larger return\n", markdown(better)]
    parts += ["## Mean return of the runs after so many steps\n", markdown(_table_over_steps(runs, results.names))]
    write_page(folder / "returns.md", f"{results.simulator}: guided and not", parts, results, command)


def mean_returns(laps: pd.DataFrame) -> pd.DataFrame:
    """One row for every column, seed and checkpoint: its mean return."""
    keys = ["column", "seed", "checkpoint"]
    return laps.groupby(keys, sort=False)["score"].mean().rename("return").reset_index()


def steps_to_return(runs: pd.DataFrame, threshold: float) -> pd.Series:
    """The first checkpoint with a mean return of the threshold or more, else infinity; by column and seed."""
    reached = runs["checkpoint"].where(runs["return"] >= threshold, math.inf)
    return reached.groupby([runs["column"], runs["seed"]], sort=False).min()


def final(runs: pd.DataFrame, name: str) -> FloatArray:
    """Mean returns of a column's runs after the whole training: (runs, 1)."""
    own = runs[runs["column"] == name]
    values: FloatArray = own[own["checkpoint"] == own["checkpoint"].max()]["return"].to_numpy()[:, None]
    return values


def improvement(runs: pd.DataFrame, results: Results) -> pd.DataFrame:
    """Each guided column against every other column that is not guided."""
    guided = [column.name for column in results.columns if "_ap" in column.algo]
    others = [name for name in results.names if name not in guided]
    rows = [
        [ours, other, *probability_of_improvement(final(runs, ours), final(runs, other))]
        for ours in guided
        for other in others
    ]
    return pd.DataFrame(rows, columns=["guided", "against", "probability", "low", "high"])


def _row(results: Results, runs: pd.DataFrame, name: str, threshold: float | None) -> dict[str, str]:
    own = runs[runs["column"] == name]
    last = results.final_laps().query("column == @name", local_dict={"name": name})
    row = {
        "column": name,
        "steps": f"{own['checkpoint'].max():,}",
        "seeds": str(own["seed"].nunique()),
        "mean return": _told(final(runs, name)),
        "worst seed": f"{final(runs, name).min():.4g}",
    }
    if threshold is not None:
        median, reached = median_reached(steps_to_return(own, threshold))
        told = f"{median:,.0f}" if math.isfinite(median) else "–"
        row[f"steps until {threshold:g}"] = f"{told} ({reached} of {own['seed'].nunique()})"
    if last["success"].notna().any():
        row["success"] = f"{last['success'].astype(float).mean():.0%}"
    curve = results.curve[results.curve["column"] == name]
    milliseconds = ms_per_step(results.times[results.times["column"] == name]).median()
    accuracy = pd.to_numeric(curve["accuracy"]).mean()
    return row | {
        "permissible": f"{last['permissible'].mean():.1%}",
        "accuracy of E": "" if np.isnan(accuracy) else f"{accuracy:.3f}",
        "ms per step": "" if np.isnan(milliseconds) else f"{milliseconds:.1f}",
    }


def _table_over_steps(runs: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    rows = []
    for name in names:
        for checkpoint, at in runs[runs["column"] == name].groupby("checkpoint"):
            values = at["return"].to_numpy()[:, None]
            rows.append([name, f"{checkpoint:,}", _told(values), f"{values.min():.4g}"])
    return pd.DataFrame(rows, columns=["column", "steps", "mean return", "worst seed"])


def _told(values: FloatArray) -> str:
    low, high = bootstrap_interval(values)
    return f"{interquartile_mean(values):.4g} [{low:.4g}, {high:.4g}]"


def _figure(runs: pd.DataFrame, results: Results) -> Figure:
    learners = [column.name for column in results.columns if column.learns]
    figure = line_figure(runs, learners, "checkpoint", "return", "training step", "mean return of the actor alone")
    axes = figure.axes[0]
    for name in set(results.names) - set(learners):
        level = interquartile_mean(final(runs, name))
        axes.axhline(level, color="k", linestyle="--", linewidth=0.8)
        axes.annotate(name, (1, level), xycoords=("axes fraction", "data"), va="bottom", ha="right")
    # A peer's longer training would press ours against the axis.
    lengths = runs[runs["column"].isin(learners)].groupby("column")["checkpoint"].max()
    if lengths.max() > 2 * lengths.min():
        axes.set_xscale("log")
    return figure
