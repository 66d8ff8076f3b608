"""Figures 4a, 4b and 5 of the paper, and S and laps on the test tracks over training steps."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from sb3_sap.benchmark.reports.drawing import curve_figure, episodes_figure, line_figure
from sb3_sap.benchmark.reports.measures import LOST
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.reports.results import NoResults, Results
from sb3_sap.benchmark.reports.tables import curve_table
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY

#: Training steps that Figure 5 shows.
ACCURACY_STEPS = 5_000
BAND = "The line is the interquartile mean over seeds, and the band is its 95 % bootstrap interval.\n"


def figure_4(results: Results, folder: Path, command: str, name: str = "figure4") -> None:
    """Writes the page, and figures 4a and 4b as SVG and CSV.

    :param name: of the page, with which the names of the other files agree
    """
    suffix = name.removeprefix("figure4")
    a, b = f"figure4a{suffix}", f"figure4b{suffix}"
    write_csv(folder / f"{a}.csv", results.curve[["configuration", "seed", "step", "reward"]])
    episodes = with_averages(results.episodes)
    write_csv(folder / f"{b}.csv", episodes)
    averages = line_figure(
        results.curve, results.names, "step", "reward", "training step", "reward, mean of the last 100 steps"
    )
    write_figure(folder / f"{a}.svg", averages)
    write_figure(folder / f"{b}.svg", episodes_figure(episodes, results.names))
    parts = [
        f"## 4a: average reward over the last 100 training steps\n\n![Figure 4a]({a}.svg)\n",
        BAND,
        f"## 4b: average reward of each training episode\n\n![Figure 4b]({b}.svg)\n",
        "Each line is the reward per step in the episodes of one training run, which ends at the dot. A run that stays "
        "on the road has few episodes, because an episode lasts until the car leaves the road.\n",
    ]
    title = f"Figure 4 ({results.simulator}, {results.steps:,} steps)"
    write_page(folder / f"{name}.md", title, parts, results, command)


def figure_5(results: Results, folder: Path, command: str, name: str = "figure5") -> None:
    """Writes the page, and the figure as SVG and CSV.

    :param name: of all three
    :raise NoResults: if no configuration has an AP predictor
    """
    curve = results.curve[results.curve["accuracy"].notna() & (results.curve["step"] <= ACCURACY_STEPS)]
    if curve.empty:
        raise NoResults("none of these configurations has an AP predictor.")
    curve = curve.astype({"accuracy": float, "lowest_accuracy": float})
    write_csv(folder / f"{name}.csv", curve.drop(columns="reward"))
    names = [name for name in results.names if (curve["configuration"] == name).any()]
    figure = line_figure(curve, names, "step", "accuracy", "training step", "balanced validation accuracy of E")
    figure.axes[0].axhline(SUFFICIENT_ACCURACY, color="0.5", linestyle=":")
    write_figure(folder / f"{name}.svg", figure)
    note = "The dotted line is the accuracy of 70 % from which α has its full value.\n"
    parts = [f"![Figure 5]({name}.svg)\n", BAND, note]
    title = f"Figure 5: validation accuracy of the AP predictor ({results.simulator})"
    write_page(folder / f"{name}.md", title, parts, results.only(names), command)


def curve(results: Results, folder: Path, command: str) -> None:
    """Writes ``curve.md``, and the laps of the actor on the test tracks as SVG and CSV.

    :raise NoResults: if no configuration learns
    """
    if not any(configuration.learns for configuration in results.configurations):
        raise NoResults("none of these configurations learns.")
    write_csv(folder / "curve.csv", results.laps)
    table = curve_table(results)
    write_figure(folder / "curve.svg", curve_figure(table, results.configurations))
    formatted = pd.DataFrame(
        {
            "configuration": table["configuration"],
            "steps": table["checkpoint"],
            "laps done": [f"{done} of {laps}" for done, laps in table[["laps_done", "laps"]].to_numpy()],
            "S": [f"{s:.3f} [{low:.3f}, {high:.3f}]" for s, low, high in table[["score", "low", "high"]].to_numpy()],
        }
    )
    title = f"The test tracks over training steps ({results.simulator})"
    write_page(folder / "curve.md", title, ["![Curve](curve.svg)\n", BAND, markdown(formatted)], results, command)


def with_averages(episodes: pd.DataFrame) -> pd.DataFrame:
    """Adds the number of each episode, counted from 1, its average reward, and whether the car was lost."""
    number = episodes.groupby(["configuration", "seed"], sort=False).cumcount() + 1
    average = (episodes["total_reward"] / episodes["length"]).round(4)
    return episodes.assign(episode=number, average_reward=average, lost=episodes["ended"].isin(LOST))
