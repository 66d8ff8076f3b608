"""Figures of runs: lines with their intervals, and panels of configurations that are compared."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter
from scipy import stats

from sb3_sap.benchmark.configurations import Configuration, parse_configuration
from sb3_sap.evaluation.statistics import bootstrap_interval

#: Width of a figure in inches.
WIDTH = 9
#: Letters of a legend that fit side by side below a figure.
LEGEND_WIDTH = 110
#: The module of a dotted name.
_MODULE = re.compile(r"\b[a-z]\w*\.(\w+\.)*(?=[A-Za-z_])")
#: Maximum number of lines in one panel where configurations are of several algorithms.
TOGETHER = 8


def line_figure(table: pd.DataFrame, names: list[str], x: str, y: str, x_label: str, y_label: str) -> Figure:
    """A line for every configuration: the interquartile mean of ``y`` over its runs, and its bootstrap interval.

    More than `TOGETHER` have a panel for each algorithm, in all of which equal settings have the same colour.
    """
    panels_of, colours = [names], {name: number for number, name in enumerate(names)}
    if len(names) > TOGETHER:
        panels_of = [list(group) for _, group in itertools.groupby(names, lambda name: name.partition(":")[0])]
        settings = {name: replace(own, algo="") for group in panels_of for name, own in _distinct(group).items()}
        colours = {name: list(dict.fromkeys(settings.values())).index(own) for name, own in settings.items()}
    figure = Figure(figsize=(WIDTH, 1.5 + 3 * len(panels_of)), layout="constrained")
    panels = figure.subplots(len(panels_of), squeeze=False, sharex=True, sharey=True)[:, 0]
    for axes, group in zip(panels, panels_of, strict=True):
        axes.set_ylabel(y_label)
        axes.grid(alpha=0.3)
        for name, own in _distinct(group).items():
            wide = table[table["configuration"] == name].pivot(index=x, columns="seed", values=y).dropna(how="all")
            means, bands = [], []
            for values in wide.to_numpy():
                known = values[~np.isnan(values)]
                means.append(stats.trim_mean(known, 0.25))
                bands.append(bootstrap_interval(known[:, None], resamples=500))
            _line(axes, colours[name], _MODULE.sub("", own.name), wide.index, means, *np.transpose(bands))
        if len(panels_of) > 1:
            axes.legend(loc="lower right", fontsize="small")
    panels[-1].set_xlabel(x_label)
    if len(panels_of) == 1:
        labels = panels[0].get_legend_handles_labels()[1]
        beside = LEGEND_WIDTH // (6 + max(map(len, labels)))  # line and gap of an entry are as wide as six letters
        figure.legend(loc="outside lower center", ncols=min(len(labels), max(1, beside)))
    return figure


def _distinct(names: list[str]) -> dict[str, Configuration]:
    """The configurations by name, without the overrides that all of them have."""
    parsed = [parse_configuration(name) for name in names]
    common = frozenset.intersection(*(frozenset(each.overrides) for each in parsed))
    kept = [tuple(override for override in each.overrides if override not in common) for each in parsed]
    return {name: replace(each, overrides=own) for name, each, own in zip(names, parsed, kept, strict=True)}


def episodes_figure(episodes: pd.DataFrame, names: list[str]) -> Figure:
    """A panel for every configuration and a line for every run: average reward of each episode (Fig. 4b)."""
    figure, panels = _panels(len(names), 1, 1.7)
    for number, (name, [axes]) in enumerate(zip(names, panels, strict=True)):
        for _, run in episodes[episodes["configuration"] == name].groupby("seed"):
            axes.plot(run["episode"], run["average_reward"], color=f"C{number}", alpha=0.6, linewidth=0.8)
            axes.plot(run["episode"].iloc[-1], run["average_reward"].iloc[-1], "o", color=f"C{number}", markersize=3)
        axes.set_title(name, loc="left", fontsize="medium")
    figure.supylabel("average reward of the episode", fontsize="medium")
    _scale_steps(panels[-1][0], "training episode")
    return figure


def curve_figure(table: pd.DataFrame, configurations: list[Configuration]) -> Figure:
    """A row of panels for every family of configurations: S with its interval, and laps done, over training steps."""
    families = _families(configurations)
    figure, panels = _panels(len(families), 2, 2.3)
    for family, (left, right) in zip(families.values(), panels, strict=True):
        for number, configuration in enumerate(family):
            rows = table[table["configuration"] == configuration.name]
            _line(left, number, configuration.name, rows["checkpoint"], rows["score"], rows["low"], rows["high"])
            right.plot(rows["checkpoint"], rows["laps_done"] / rows["laps"], color=f"C{number}", linewidth=1.3)
        for configuration in configurations:
            if not configuration.learns:
                score = table.loc[table["configuration"] == configuration.name, "score"].iloc[0]
                left.axhline(score, color="k", linestyle="--", linewidth=0.8, label=configuration.name)
        left.legend(loc="lower right", fontsize="small")
    panels[0][0].set_title("S on the unseen tracks", loc="left", fontsize="medium")
    panels[0][1].set_title("share of laps done", loc="left", fontsize="medium")
    for axes in panels[-1]:
        _scale_steps(axes, "training step")
    return figure


def _families(configurations: list[Configuration]) -> dict[str, list[Configuration]]:
    """Configurations that are compared: the paper's with one another, all others with those of the same base."""
    families: dict[str, list[Configuration]] = {}
    for configuration in configurations:
        if configuration.learns:
            base = re.sub(r"^sbx_|_(ap|ce).*$", "", configuration.algo)
            family = "paper" if configuration.preset == "paper" else base
            families.setdefault(family, []).append(configuration)
    return families


def _panels(rows: int, beside: int, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(WIDTH, max(3.5, 0.6 + height * rows)), layout="constrained")
    panels = figure.subplots(rows, beside, squeeze=False, sharex=True, sharey="col")
    for axes in panels.flat:
        axes.grid(alpha=0.3)
    return figure, panels


def _scale_steps(axes: Any, label: str) -> None:
    """Scales the steps logarithmically, because most of the learning happens early."""
    axes.set(xscale="log", xlabel=label)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _line(axes: Any, number: int, name: str, x: Any, y: Any, low: Any, high: Any) -> None:
    # There are ten colours.
    axes.plot(x, y, label=name, color=f"C{number}", linestyle="-" if number < 10 else "--", linewidth=1.3)
    axes.fill_between(x, low, high, color=f"C{number}", alpha=0.12, linewidth=0)
