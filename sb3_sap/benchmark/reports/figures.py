"""Figures 4a, 4b and 5 of the paper, and the curve of S and laps on unseen tracks against training steps."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from sb3_sap.benchmark.drawing import curve_figure, episodes_figure, line_figure
from sb3_sap.benchmark.measures import LOST
from sb3_sap.benchmark.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.results import NoResults, Results
from sb3_sap.benchmark.tables import curve_table

#: Training steps that Fig. 5 shows.
ACCURACY_STEPS = 5_000
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
    write_figure(folder / "figure4b", episodes_figure(episodes, results.names))
    parts = [
        "## 4a: average reward over the last 100 training steps\n\n![Figure 4a](figure4a.svg)\n",
        BAND,
        "## 4b: average reward of each training episode\n\n![Figure 4b](figure4b.svg)\n",
        "Each line is one training run, to the dot: the reward per step of one episode after the other. A run that "
        "stays on the road has few episodes, since an episode lasts as long as it does.\n",
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
    if not any(column.learns for column in results.columns):
        raise NoResults("none of these columns learns, so there is no curve.")
    write_csv(folder / "curve.csv", results.laps)
    table = curve_table(results)
    write_figure(folder / "curve", curve_figure(table, results.columns))
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
