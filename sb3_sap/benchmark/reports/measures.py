"""Measures of single runs and of configurations."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from sb3_sap.benchmark.reports.results import Results
from sb3_sap.common.arrays import FloatArray
from sb3_sap.evaluation.statistics import bootstrap_interval, interquartile_mean

#: Values of S on every test track from which a policy is called competent.
THRESHOLDS = (0.9, 0.95)
#: Ends of episodes in which the car was lost.
LOST = ("off track", "backwards")


def score_matrix(laps: pd.DataFrame, configuration: str) -> FloatArray:
    """S of the laps of one configuration: (runs, tracks)."""
    own = laps[laps["configuration"] == configuration]
    matrix: FloatArray = own.pivot(index="seed", columns="track", values="score").to_numpy()
    return matrix


def steps_to_competence(laps: pd.DataFrame, threshold: float) -> pd.Series:
    """The first checkpoint at which every test lap is completed with S at or above the threshold, else infinity.

    The series is indexed by configuration and seed.
    """
    good = laps["lap_done"].astype(bool) & (laps["score"] >= threshold)
    keys = ["configuration", "seed", "checkpoint"]
    all_good = laps.assign(good=good).groupby(keys, sort=False)["good"].all().reset_index()
    checkpoint = all_good["checkpoint"].where(all_good["good"], math.inf)
    return checkpoint.groupby([all_good["configuration"], all_good["seed"]], sort=False).min()


def seconds_to_competence(results: Results, threshold: float) -> pd.Series:
    """Processor seconds from the start of the process until then, without evaluations.

    A run has one thread, so that this is the time that a user waits on an idle machine. Wall-clock time would also
    measure the other processes of the machine.
    """
    steps = steps_to_competence(results.laps, threshold).rename("checkpoint").reset_index()
    times = results.times.astype({"checkpoint": float})
    found = steps.merge(times, on=["configuration", "seed", "checkpoint"], how="left")
    seconds = found["process_seconds"].astype(float).fillna(math.inf)
    seconds[found["checkpoint"] == 0] = 0.0  # a controller, which is not trained
    return seconds.set_axis(pd.MultiIndex.from_frame(found[["configuration", "seed"]]))


def ms_per_step(times: pd.DataFrame) -> pd.Series:
    """Processor milliseconds of a training step after the first checkpoint, by configuration and seed."""
    by_run = times.groupby(["configuration", "seed"], sort=False)[["checkpoint", "process_seconds"]]
    spent = by_run.last() - by_run.first()
    milliseconds: pd.Series = 1000 * spent["process_seconds"] / spent["checkpoint"]
    return milliseconds


def per_run(results: Results) -> pd.DataFrame:
    """All measures, one row for every run, indexed by configuration and seed."""
    keys = ["configuration", "seed"]
    final = results.final_laps()
    by_run = final.groupby(keys, sort=False)
    runs = pd.DataFrame({"laps_done": by_run["lap_done"].sum(), "laps": by_run.size(), "score": by_run["score"].mean()})
    for threshold in THRESHOLDS:
        runs[f"steps_to_{threshold}"] = steps_to_competence(results.laps, threshold)
    runs["seconds_to_0.95"] = seconds_to_competence(results, 0.95)
    lost = results.episodes[results.episodes["ended"].isin(LOST)]
    learners = [configuration.name for configuration in results.configurations if configuration.learns]
    learns = runs.index.get_level_values("configuration").isin(learners)
    runs["off_track"] = lost.groupby(keys).size()
    runs.loc[learns, "off_track"] = runs.loc[learns, "off_track"].fillna(0)
    runs["last_off_track"] = lost.groupby(keys)["end"].max()
    runs.loc[learns, "last_off_track"] = runs.loc[learns, "last_off_track"].fillna(0)
    runs["ms_per_step"] = ms_per_step(results.times)
    accuracy = results.curve.groupby(keys, sort=False)
    runs["accuracy"] = accuracy["accuracy"].mean()
    runs["lowest_accuracy"] = accuracy["lowest_accuracy"].min()
    return runs


def scores_with_interval(final_laps: pd.DataFrame, configuration: str) -> tuple[float, float, float]:
    """Interquartile mean of S over runs and tracks, and its 95 % bootstrap interval."""
    matrix = score_matrix(final_laps, configuration)
    return interquartile_mean(matrix), *bootstrap_interval(matrix)


def median_reached(values: pd.Series) -> tuple[float, int]:
    """Median over runs, in which a run that never got there counts as infinite, and the number of runs that did."""
    return float(np.quantile(values, 0.5, method="lower")), int(np.isfinite(values).sum())
