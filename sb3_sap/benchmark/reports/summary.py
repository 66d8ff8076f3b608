"""Statistics of all configurations, and the probabilities that a guided one improves on others."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sap.algorithms import base_of, is_guided
from sb3_sap.benchmark.configurations import Configuration
from sb3_sap.benchmark.groups import BASELINES
from sb3_sap.benchmark.learners import environment_of, plain_name
from sb3_sap.benchmark.reports.measures import (
    THRESHOLDS,
    median_reached,
    per_run,
    score_matrix,
    scores_with_interval,
)
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_page
from sb3_sap.benchmark.reports.results import NoResults, Results
from sb3_sap.evaluation.statistics import interquartile_mean, probability_of_improvement

NOTE = (
    "Laps and S are those of the actor alone on the test tracks after the whole training. S is the interquartile mean "
    "over seeds and tracks with its 95 % stratified bootstrap interval; the worst seed has the lowest mean over "
    "tracks. A run is *competent* from the first checkpoint at which it completes every test lap with S at or above "
    "the threshold. Steps and seconds until then are medians over seeds, in which a run that never gets there counts "
    "as infinite, and the number of seeds that do is in brackets. Times are processor times without evaluations: since "
    "a run has one thread, a user waits as long on an idle machine. Seconds count from the start of the process, "
    "milliseconds from the first checkpoint. Episodes off the road are training episodes that end with the car off the "
    "road or facing backwards, as medians over seeds. The accuracy of E is balanced, on validation examples.\n"
)


def summary(results: Results, folder: Path, command: str, name: str = "summary") -> None:
    """Writes ``NAME.md``, ``NAME.csv`` with a row for every run, and ``NAME_improvement.csv``.

    :raise NoResults: if there are results of one configuration only, unless the name is "summary"
    """
    if name != "summary" and len(results.configurations) < 2:
        raise NoResults(
            f"of these configurations, {results.names[0]} alone has results, which leaves nothing to compare."
        )
    runs = per_run(results)
    write_csv(folder / f"{name}.csv", runs.reset_index().round(6))
    laps = results.final_laps()
    rows = [_summary_row(runs.loc[[configuration]], laps, configuration) for configuration in results.names]
    parts = [markdown(pd.DataFrame(rows)), NOTE]
    improvements = improvement(results)
    if len(improvements):
        write_csv(folder / f"{name}_improvement.csv", improvements.round(6))
        intervals = [f"{p:.2f} [{low:.2f}, {high:.2f}]" for p, low, high in improvements.iloc[:, 2:].to_numpy()]
        table = improvements.iloc[:, :2].assign(**{"probability of improvement": intervals})
        parts += ["## Probability that a guided run beats one of another configuration on a test track\n"]
        parts += [markdown(table)]
    title = f"{results.steps:,} training steps on Wheel-2, then the test tracks ({results.simulator})"
    write_page(folder / f"{name}.md", title, parts, results, command)


def _summary_row(runs: pd.DataFrame, laps: pd.DataFrame, name: str) -> dict[str, str]:
    mean, low, high = scores_with_interval(laps, name)
    row = {
        "configuration": name,
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
    """Compares each guided configuration with itself without overrides, its base and the best baseline.

    Only configurations with the same options of the environment are compared.

    :return: columns ``guided``, ``against``, ``probability``, ``low`` and ``high``
    """
    laps = results.final_laps()
    rows = []
    for ours in results.configurations:
        if not is_guided(plain_name(ours.algo)):
            continue
        alike = [other for other in results.configurations if environment_of(other) == environment_of(ours)]
        baselines = [other for other in alike if other.algo in BASELINES and other.preset in ("default", "tuned")]
        best = max(baselines, key=lambda one: interquartile_mean(score_matrix(laps, one.name)), default=None)
        base = base_of(plain_name(ours.algo))
        others = [other for other in alike if other.algo == base]
        if ours.preset == "paper":
            others = [other for other in others if other.preset == "paper"] or others
        others = [other for other in others if other.overrides == ours.overrides] or others
        unchanged = [other for other in alike if ours.overrides and other == Configuration(ours.algo, ours.preset)]
        for other in dict.fromkeys([*unchanged, *others, *([best] if best else [])]):
            estimate = probability_of_improvement(score_matrix(laps, ours.name), score_matrix(laps, other.name))
            best_mark = " (best baseline)" if other == best else ""
            rows.append([ours.name, other.name + best_mark, *estimate])
    return pd.DataFrame(rows, columns=["guided", "against", "probability", "low", "high"])
