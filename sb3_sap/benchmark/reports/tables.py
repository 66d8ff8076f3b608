"""Table 2 of the paper beside our figures, and S and laps over training steps."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from sb3_sap.benchmark.configurations import Configuration
from sb3_sap.benchmark.paper import TABLE_2, paper_score
from sb3_sap.benchmark.reports.measures import score_matrix, scores_with_interval
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_page, write_text
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.envs import TRACKS
from sb3_sap.evaluation.statistics import bootstrap_interval, interquartile_mean

NOTE = (
    "S is the total reward relative to a perfect lap. The paper's S is computed from its total reward for the control "
    "step of 0.2 s, which its totals imply. Our figures are interquartile means over seeds, and S has a 95 % bootstrap "
    "interval.\n"
)
#: Training steps that the headline shows.
HEADLINE = (250, 500, 1_000, 3_000)


def table_2(results: Results, folder: Path, command: str, name: str = "table2") -> None:
    """Writes the page, and its data as CSV.

    :param name: of both
    """
    laps = results.final_laps()
    write_csv(folder / f"{name}.csv", laps)
    rows = [
        _table_2_row(laps, configuration, track, results.steps)
        for track in dict.fromkeys(laps["track"])
        for configuration in results.configurations
    ]
    title = (
        f"Table 2: one lap of each test track after {results.steps:,} training steps on Wheel-2 ({results.simulator})"
    )
    write_page(folder / f"{name}.md", title, [markdown(pd.DataFrame(rows)), NOTE], results, command)


def _table_2_row(laps: pd.DataFrame, configuration: Configuration, track: str, steps: int) -> dict[str, str]:
    ours = laps[(laps["configuration"] == configuration.name) & (laps["track"] == track)]
    mean, low, high = scores_with_interval(ours, configuration.name)
    row = {
        "test track": TRACKS.get(track, track),
        "configuration": configuration.name,
        "laps done": f"{ours['lap_done'].sum()} of {len(ours)}",
        "covered": f"{interquartile_mean(ours['covered'].to_numpy()):.1%}",
        "total reward": f"{interquartile_mean(ours['total_reward'].to_numpy()):,.0f}",
        "S": f"{mean:.3f} [{low:.3f}, {high:.3f}]",
    }
    paper = TABLE_2.get(steps, {}).get(configuration.algo, {}).get(track)
    return row | {
        "paper: lap done": "" if paper is None else "yes" if paper.covered == 1 else f"no ({paper.covered:.1%})",
        "paper: total reward": "" if paper is None else f"{paper.total_reward:,.0f}",
        "paper: S": "" if paper is None else f"{paper_score(track, paper.total_reward):.3f}",
    }


def curve_table(results: Results) -> pd.DataFrame:
    """Laps done and S with its interval, one row for every configuration and checkpoint."""
    rows = []
    for (name, checkpoint), laps in results.laps.groupby(["configuration", "checkpoint"], sort=False):
        matrix = score_matrix(laps, name)
        low, high = bootstrap_interval(matrix)
        done = [int(laps["lap_done"].sum()), len(laps)]
        rows.append([name, checkpoint, *done, interquartile_mean(matrix), low, high])
    return pd.DataFrame(rows, columns=["configuration", "checkpoint", "laps_done", "laps", "score", "low", "high"])


def headline(results: Results, folder: Path, command: str) -> None:
    """Writes ``headline.md``, a table alone: S and laps after a few numbers of training steps."""
    del command
    table = curve_table(results)
    rows = []
    for name in results.names:
        own = table[table["configuration"] == name].set_index("checkpoint")
        row = {"configuration": name}
        for steps in HEADLINE:
            # A controller has one checkpoint, 0, and is as good from the beginning.
            at = own.loc[own.index[own.index <= steps].max()]
            s = f"{at['score']:.3f}" + (f" [{at['low']:.3f}, {at['high']:.3f}]" if at["low"] < at["high"] else "")
            row[f"S after {steps:,} steps (laps)"] = f"{s} ({at['laps_done']} of {at['laps']})"
        rows.append(row)
    write_text(folder / "headline.md", markdown(pd.DataFrame(rows)))
