"""The summary of all columns: statistics of each, and how probably a guided one beats another."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sap.benchmark.columns import PEERS, Column
from sb3_sap.benchmark.learners import environment_of
from sb3_sap.benchmark.measures import (
    THRESHOLDS,
    median_reached,
    per_run,
    score_matrix,
    scores_with_interval,
)
from sb3_sap.benchmark.pages import markdown, write_csv, write_page
from sb3_sap.benchmark.results import NoResults, Results
from sb3_sap.statistics import interquartile_mean, probability_of_improvement

NOTE = (
    "Laps and S are those after the whole training, on the unseen tracks, the actor alone; S is the interquartile mean "
    "over seeds and tracks with its 95 % stratified bootstrap interval, the worst seed by its mean over the tracks. A "
    "run is *competent* at the first checkpoint at which every unseen lap is done with S at or above the threshold: "
    "the median over seeds, a run that never is counted as infinite, and how many are. Times are of the processor, "
    "evaluation left out: as a run has one thread, they are what one waits where nothing else runs. Seconds count from "
    "the start of the process, milliseconds from the first checkpoint on. Episodes off the road are those of the "
    "training that end with the car off the road or backwards: medians over seeds. Accuracy is E's, balanced, on "
    "validation examples.\n"
)


def summary(results: Results, folder: Path, command: str, name: str = "summary") -> None:
    """Writes ``NAME.md``, ``NAME.csv`` with one row for every run, and ``NAME_improvement.csv`` of guided columns."""
    if name != "summary" and len(results.columns) < 2:
        raise NoResults(
            f"of these columns there are results of {results.names[0]} alone, and nothing to compare it with."
        )
    runs = per_run(results)
    write_csv(folder / f"{name}.csv", runs.reset_index().round(6))
    laps = results.final_laps()
    rows = [_summary_row(runs.loc[[column]], laps, column) for column in results.names]
    parts = [markdown(pd.DataFrame(rows)), NOTE]
    improvements = improvement(results)
    if len(improvements):
        write_csv(folder / f"{name}_improvement.csv", improvements.round(6))
        told = [f"{p:.2f} [{low:.2f}, {high:.2f}]" for p, low, high in improvements.iloc[:, 2:].to_numpy()]
        table = improvements.iloc[:, :2].assign(**{"probability of improvement": told})
        parts += ["## How probably a guided run beats one of another column on an unseen track\n", markdown(table)]
    title = f"{results.steps:,} training steps on Wheel-2, then the unseen tracks ({results.simulator})"
    write_page(folder / f"{name}.md", title, parts, results, command)


def _summary_row(runs: pd.DataFrame, laps: pd.DataFrame, name: str) -> dict[str, str]:
    mean, low, high = scores_with_interval(laps, name)
    row = {
        "column": name,
        "seeds": str(len(runs)),
        "laps done": f"{runs['laps_done'].sum()} of {runs['laps'].sum()}",
        "S": f"{mean:.3f} [{low:.3f}, {high:.3f}]" if len(runs) > 1 else f"{mean:.3f}",
        "worst seed": f"{runs['score'].min():.3f}",
    }
    for threshold in THRESHOLDS:
        row[f"steps until S ≥ {threshold}"] = _reached(runs[f"steps_to_{threshold}"])
    lowest = runs["lowest_accuracy"].min()
    return row | {
        "seconds until S ≥ 0.95": _reached(runs["seconds_to_0.95"]),
        "episodes off the road": _number(runs["off_track"].median()),
        "the last at step": _number(runs["last_off_track"].median()),
        "ms per step": _number(runs["ms_per_step"].median(), 1),
        "accuracy of E (lowest)": "" if np.isnan(lowest) else f"{runs['accuracy'].mean():.3f} ({lowest:.3f})",
    }


def _reached(values: pd.Series) -> str:
    median, reached = median_reached(values)
    return f"{median:,.0f} ({reached} of {len(values)})" if math.isfinite(median) else f"– ({reached} of {len(values)})"


def _number(value: float, digits: int = 0) -> str:
    return "" if np.isnan(value) else f"{value:,.{digits}f}"


def improvement(results: Results) -> pd.DataFrame:
    """Each guided column against itself unchanged, its base and the best peer, in the same environment."""
    laps = results.final_laps()
    rows = []
    for ours in results.columns:
        if "_ap" not in ours.algo:
            continue
        alike = [column for column in results.columns if environment_of(column) == environment_of(ours)]
        peers = [c for c in alike if c.algo in PEERS and c.preset in ("default", "tuned")]
        best = max(peers, key=lambda peer: interquartile_mean(score_matrix(laps, peer.name)), default=None)
        base = ours.algo.partition("_ap")[0]
        others = [column for column in alike if column.algo == base]
        if ours.preset == "paper":
            others = [column for column in others if column.preset == "paper"] or others
        others = [column for column in others if column.overrides == ours.overrides] or others
        unchanged = [c for c in alike if ours.overrides and c == Column(ours.algo, ours.preset)]
        for other in dict.fromkeys([*unchanged, *others, *([best] if best else [])]):
            estimate = probability_of_improvement(score_matrix(laps, ours.name), score_matrix(laps, other.name))
            best_mark = " (best peer)" if other == best else ""
            rows.append([ours.name, other.name + best_mark, *estimate])
    return pd.DataFrame(rows, columns=["guided", "against", "probability", "low", "high"])
