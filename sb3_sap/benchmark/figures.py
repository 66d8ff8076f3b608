"""Figures 4a, 4b and 5 of the paper, and the curve of S and laps on unseen tracks against training steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import stats

from sb3_sap.benchmark.measures import LOST
from sb3_sap.benchmark.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.results import NoResults, Results
from sb3_sap.benchmark.tables import curve_table
from sb3_sap.statistics import bootstrap_interval

#: Training steps that Fig. 5 shows.
ACCURACY_STEPS = 5_000
#: Letters that fit side by side below a figure.
LEGEND_WIDTH = 110
BAND = "The line is the interquartile mean over seeds, the band its 95 % bootstrap interval.\n"


def figure_4(results: Results, folder: Path, command: str) -> None:
    """Writes ``figure4.md``, and pictures and tables of 4a and 4b."""
    write_csv(folder / "figure4a.csv", results.curve[["column", "seed", "step", "reward"]])
    episodes = with_averages(results.episodes)
    write_csv(folder / "figure4b.csv", episodes)
    a = line_figure(
        results.curve, results.names, "step", "reward", "training step", "reward, mean of the last 100 steps"
    )
    write_figure(folder / "figure4a", a)
    write_figure(folder / "figure4b", _episodes_figure(episodes, results.names))
    parts = [
        "## 4a: average reward over the last 100 training steps\n\n![Figure 4a](figure4a.svg)\n",
        BAND,
        "## 4b: average reward of each training episode\n\n![Figure 4b](figure4b.svg)\n",
        "Each line is one training run: the reward per step of one episode after the other. A run that stays on the "
        "road has few episodes, since an episode lasts as long as it does.\n",
    ]
    write_page(
        folder / "figure4.md", f"Figure 4 ({results.simulator}, {results.steps:,} steps)", parts, results, command
    )


def figure_5(results: Results, folder: Path, command: str) -> None:
    """Writes ``figure5.md``, its picture and its table."""
    curve = results.curve[results.curve["accuracy"].notna() & (results.curve["step"] <= ACCURACY_STEPS)]
    if curve.empty:
        raise NoResults("none of these columns has an AP predictor whose accuracy could be shown.")
    curve = curve.astype({"accuracy": float, "lowest_accuracy": float})
    write_csv(folder / "figure5.csv", curve.drop(columns="reward"))
    names = [name for name in results.names if (curve["column"] == name).any()]
    figure = line_figure(curve, names, "step", "accuracy", "training step", "balanced validation accuracy of E")
    figure.axes[0].axhline(0.7, color="0.5", linestyle=":")
    write_figure(folder / "figure5", figure)
    parts = ["![Figure 5](figure5.svg)\n", BAND, "The dotted line is the 70 % above which α takes its full value.\n"]
    title = f"Figure 5: validation accuracy of the AP predictor ({results.simulator})"
    write_page(folder / "figure5.md", title, parts, results.only(names), command)


def curve(results: Results, folder: Path, command: str) -> None:
    """Writes ``curve.md``, its picture and its table: what the actor does on unseen tracks as it learns."""
    write_csv(folder / "curve.csv", results.laps)
    table = curve_table(results)
    write_figure(folder / "curve", _curve_figure(table, results.names))
    told = pd.DataFrame(
        {
            "column": table["column"],
            "steps": table["checkpoint"],
            "laps done": [f"{done} of {laps}" for done, laps in table[["laps_done", "laps"]].to_numpy()],
            "S": [f"{s:.3f} [{low:.3f}, {high:.3f}]" for s, low, high in table[["score", "low", "high"]].to_numpy()],
        }
    )
    title = f"The unseen tracks against training steps ({results.simulator})"
    write_page(folder / "curve.md", title, ["![Curve](curve.svg)\n", BAND, markdown(told)], results, command)


def with_averages(episodes: pd.DataFrame) -> pd.DataFrame:
    """The episodes with their number, from 1, their average reward, and whether the car was lost."""
    number = episodes.groupby(["column", "seed"], sort=False).cumcount() + 1
    average = (episodes["total_reward"] / episodes["length"]).round(4)
    return episodes.assign(episode=number, average_reward=average, lost=episodes["ended"].isin(LOST))


def line_figure(table: pd.DataFrame, names: list[str], x: str, y: str, x_label: str, y_label: str) -> Figure:
    """A line for every column: ``y`` of its runs over ``x``, the interquartile mean and its band."""
    figure, axes = _axes(x_label, y_label)
    for number, name in enumerate(names):
        wide = table[table["column"] == name].pivot(index=x, columns="seed", values=y).dropna(how="all")
        means, bands = [], []
        for values in wide.to_numpy():
            known = values[~np.isnan(values)]
            means.append(stats.trim_mean(known, 0.25))
            bands.append(bootstrap_interval(known[:, None], resamples=500))
        _line(axes, number, name, wide.index, means, *np.transpose(bands))
    _legend(figure)
    return figure


def _episodes_figure(episodes: pd.DataFrame, names: list[str]) -> Figure:
    figure, axes = _axes("training episode", "average reward of the episode")
    for number, name in enumerate(names):
        for seed, run in episodes[episodes["column"] == name].groupby("seed"):
            label = name if seed == episodes["seed"].min() else None
            axes.plot(run["episode"], run["average_reward"], color=f"C{number}", alpha=0.5, linewidth=0.8, label=label)
            axes.plot(run["episode"].iloc[-1], run["average_reward"].iloc[-1], "o", color=f"C{number}", markersize=3)
    axes.set_xscale("log")
    _legend(figure)
    return figure


def _curve_figure(table: pd.DataFrame, names: list[str]) -> Figure:
    figure = Figure(figsize=(9, 7), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    for number, name in enumerate(names):
        rows = table[table["column"] == name]
        if len(rows) == 1:  # the controller that learns nothing
            top.axhline(rows["score"].iloc[0], color="k", linestyle="--", linewidth=0.8, label=name)
            continue
        _line(top, number, name, rows["checkpoint"], rows["score"], rows["low"], rows["high"])
        bottom.plot(rows["checkpoint"], rows["laps_done"] / rows["laps"], **_style(number))
    top.set_ylabel("S on the unseen tracks")
    bottom.set(xlabel="training step", ylabel="share of laps done")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    _legend(figure)
    return figure


def _axes(x_label: str, y_label: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.grid(alpha=0.3)
    return figure, axes


def _line(axes: Any, number: int, name: str, x: Any, y: Any, low: Any, high: Any) -> None:
    axes.plot(x, y, label=name, **_style(number))
    axes.fill_between(x, low, high, color=f"C{number % 10}", alpha=0.12, linewidth=0)


def _style(number: int) -> dict[str, Any]:
    # Ten colours, then the same ones dashed and dotted.
    return {"color": f"C{number % 10}", "linestyle": ("-", "--", ":", "-.")[number // 10 % 4], "linewidth": 1.3}


def _legend(figure: Figure) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    beside = LEGEND_WIDTH // (6 + max(map(len, labels)))  # a line and a gap are as wide as six letters
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), max(1, beside)))
