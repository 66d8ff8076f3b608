"""The page of a task beyond lane keeping: returns over training steps and at the end."""

from __future__ import annotations

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_sap.algorithms import is_guided
from sb3_sap.benchmark.learners import plain_name
from sb3_sap.benchmark.reports.drawing import line_figure
from sb3_sap.benchmark.reports.measures import median_reached, ms_per_step
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.common.arrays import FloatArray
from sb3_sap.evaluation.environments import find_environment
from sb3_sap.evaluation.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement

NOTE = (
    "The return of a run is the mean over its evaluation episodes, which have the same seeds in every run and are "
    "those of the actor alone. Mean returns are interquartile means over runs with 95 % bootstrap intervals. "
    "*Permissible* is the share of the actor's actions in the last evaluation that the AP function of the task "
    "permits: where a policy has learned the task, a lower share shows how far the function is from being sound. "
    "Milliseconds per step are processor time.\n"
)


def returns(results: Results, folder: Path, command: str) -> None:
    """Writes ``returns.md``, ``returns.svg``, ``returns.csv`` of all episodes and ``returns_improvement.csv``."""
    write_csv(folder / "returns.csv", results.laps.drop(columns="score").rename(columns={"track": "episode"}))
    runs = mean_returns(results.laps)
    write_figure(folder / "returns.svg", _figure(runs, results))
    find_environment(results.simulator)
    spec = gym.spec(results.simulator)
    table = pd.DataFrame([_row(results, runs, name, spec.reward_threshold) for name in results.names])
    improvements = improvement(runs, results)
    write_csv(folder / "returns_improvement.csv", improvements.round(6))
    intervals = [f"{p:.2f} [{low:.2f}, {high:.2f}]" for p, low, high in improvements.iloc[:, 2:].to_numpy()]
    parts = ["![Returns](returns.svg)\n", markdown(table), NOTE]
    if intervals:
        better = improvements.iloc[:, :2].assign(**{"probability of improvement": intervals})
        parts += ["## Probability that a guided run ends with the larger return\n", markdown(better)]
    parts += ["## Mean return of the runs over training steps\n", markdown(_table_over_steps(runs, results.names))]
    write_page(folder / "returns.md", f"{results.simulator}, with guidance and without", parts, results, command)


def mean_returns(laps: pd.DataFrame) -> pd.DataFrame:
    """Mean return of every run at every checkpoint: columns ``configuration``, ``seed``, ``checkpoint``, ``return``."""
    keys = ["configuration", "seed", "checkpoint"]
    return laps.groupby(keys, sort=False)["score"].mean().rename("return").reset_index()


def steps_to_return(runs: pd.DataFrame, threshold: float) -> pd.Series:
    """The first checkpoint with a mean return of at least the threshold, else infinity; by configuration and seed."""
    reached = runs["checkpoint"].where(runs["return"] >= threshold, math.inf)
    return reached.groupby([runs["configuration"], runs["seed"]], sort=False).min()


def final(runs: pd.DataFrame, name: str) -> FloatArray:
    """Mean returns of a configuration's runs after the whole training: (runs, 1)."""
    own = runs[runs["configuration"] == name]
    values: FloatArray = own[own["checkpoint"] == own["checkpoint"].max()]["return"].to_numpy()[:, None]
    return values


def improvement(runs: pd.DataFrame, results: Results) -> pd.DataFrame:
    """Compares each guided configuration with every configuration without guidance."""
    guided = [
        configuration.name for configuration in results.configurations if is_guided(plain_name(configuration.algo))
    ]
    others = [name for name in results.names if name not in guided]
    rows = [
        [ours, other, *probability_of_improvement(final(runs, ours), final(runs, other))]
        for ours in guided
        for other in others
    ]
    return pd.DataFrame(rows, columns=["guided", "against", "probability", "low", "high"])


def _row(results: Results, runs: pd.DataFrame, name: str, threshold: float | None) -> dict[str, str]:
    own = runs[runs["configuration"] == name]
    last = results.final_laps().query("configuration == @name", local_dict={"name": name})
    row = {
        "configuration": name,
        "steps": f"{own['checkpoint'].max():,}",
        "seeds": str(own["seed"].nunique()),
        "mean return": _with_interval(final(runs, name)),
        "worst seed": f"{final(runs, name).min():.4g}",
    }
    if threshold is not None:
        median, reached = median_reached(steps_to_return(own, threshold))
        steps = f"{median:,.0f}" if math.isfinite(median) else "–"
        row[f"steps until {threshold:g}"] = f"{steps} ({reached} of {own['seed'].nunique()})"
    if last["success"].notna().any():
        row["success"] = f"{last['success'].astype(float).mean():.0%}"
    curve = results.curve[results.curve["configuration"] == name]
    milliseconds = ms_per_step(results.times[results.times["configuration"] == name]).median()
    accuracy = pd.to_numeric(curve["accuracy"]).mean()
    return row | {
        "permissible": f"{last['permissible'].mean():.1%}",
        "accuracy of E": "" if np.isnan(accuracy) else f"{accuracy:.3f}",
        "ms per step": "" if np.isnan(milliseconds) else f"{milliseconds:.1f}",
    }


def _table_over_steps(runs: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    rows = []
    for name in names:
        for checkpoint, at in runs[runs["configuration"] == name].groupby("checkpoint"):
            values = at["return"].to_numpy()[:, None]
            rows.append([name, f"{checkpoint:,}", _with_interval(values), f"{values.min():.4g}"])
    return pd.DataFrame(rows, columns=["configuration", "steps", "mean return", "worst seed"])


def _with_interval(values: FloatArray) -> str:
    low, high = bootstrap_interval(values)
    return f"{interquartile_mean(values):.4g} [{low:.4g}, {high:.4g}]"


def _figure(runs: pd.DataFrame, results: Results) -> Figure:
    learners = [configuration.name for configuration in results.configurations if configuration.learns]
    figure = line_figure(runs, learners, "checkpoint", "return", "training step", "mean return of the actor alone")
    axes = figure.axes[0]
    for name in set(results.names) - set(learners):
        level = interquartile_mean(final(runs, name))
        axes.axhline(level, color="k", linestyle="--", linewidth=0.8)
        axes.annotate(name, (1, level), xycoords=("axes fraction", "data"), va="bottom", ha="right")
    # The longer training of a baseline would leave little width for the others on a linear axis.
    lengths = runs[runs["configuration"].isin(learners)].groupby("configuration")["checkpoint"].max()
    if lengths.max() > 2 * lengths.min():
        axes.set_xscale("log")
    return figure
