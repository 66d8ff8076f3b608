"""What is measured of each training run and of each column."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from sb3_sap.benchmark.results import Results
from sb3_sap.permissibility import FloatArray
from sb3_sap.statistics import bootstrap_interval, interquartile_mean

#: S on every unseen track at which a policy is called competent.
THRESHOLDS = (0.9, 0.95)
#: How an episode ended that counts as leaving the road.
LOST = ("off track", "backwards")


def score_matrix(laps: pd.DataFrame, column: str) -> FloatArray:
    """S of the laps of one column: (runs, tracks)."""
    of_column = laps[laps["column"] == column]
    matrix: FloatArray = of_column.pivot(index="seed", columns="track", values="score").to_numpy()
    return matrix


def steps_to_competence(laps: pd.DataFrame, threshold: float) -> pd.Series:
    """The first checkpoint at which every unseen lap is done with S at or above the threshold; else infinity.

    Indexed by column and seed.
    """
    good = laps["lap_done"].astype(bool) & (laps["score"] >= threshold)
    keys = ["column", "seed", "checkpoint"]
    all_good = laps.assign(good=good).groupby(keys, sort=False)["good"].all().reset_index()
    checkpoint = all_good["checkpoint"].where(all_good["good"], math.inf)
    return checkpoint.groupby([all_good["column"], all_good["seed"]], sort=False).min()


def seconds_to_competence(results: Results, threshold: float) -> pd.Series:
    """Seconds of processor from the start of the process until then, evaluation left out.

    A run has one thread, so that they are what a user waits where nothing else runs. The wall-clock of a busy machine
    would tell of the others.
    """
    steps = steps_to_competence(results.laps, threshold).rename("checkpoint").reset_index()
    found = steps.merge(results.times.astype({"checkpoint": float}), on=["column", "seed", "checkpoint"], how="left")
    seconds = found["process_seconds"].astype(float).fillna(math.inf)
    seconds[found["checkpoint"] == 0] = 0.0  # the controller that learns nothing
    return seconds.set_axis(pd.MultiIndex.from_frame(found[["column", "seed"]]))


def ms_per_step(times: pd.DataFrame) -> pd.Series:
    """Milliseconds of processor that a training step takes from the first checkpoint on, by column and seed."""
    by_run = times.groupby(["column", "seed"], sort=False)[["checkpoint", "process_seconds"]]
    spent = by_run.last() - by_run.first()
    milliseconds: pd.Series = 1000 * spent["process_seconds"] / spent["checkpoint"]
    return milliseconds


def per_run(results: Results) -> pd.DataFrame:
    """One row for every run, indexed by column and seed."""
    keys = ["column", "seed"]
    final = results.final_laps()
    by_run = final.groupby(keys, sort=False)
    runs = pd.DataFrame({"laps_done": by_run["lap_done"].sum(), "laps": by_run.size(), "score": by_run["score"].mean()})
    for threshold in THRESHOLDS:
        runs[f"steps_to_{threshold}"] = steps_to_competence(results.laps, threshold)
    runs["seconds_to_0.95"] = seconds_to_competence(results, 0.95)
    lost = results.episodes[results.episodes["ended"].isin(LOST)]
    learners = [column.name for column in results.columns if column.learns]
    learns = runs.index.get_level_values("column").isin(learners)
    runs["off_track"] = lost.groupby(keys).size()
    runs.loc[learns, "off_track"] = runs.loc[learns, "off_track"].fillna(0)
    runs["last_off_track"] = lost.groupby(keys)["end"].max()
    runs.loc[learns, "last_off_track"] = runs.loc[learns, "last_off_track"].fillna(0)
    runs["ms_per_step"] = ms_per_step(results.times)
    accuracy = results.curve.groupby(keys, sort=False)
    runs["accuracy"] = accuracy["accuracy"].mean()
    runs["lowest_accuracy"] = accuracy["lowest_accuracy"].min()
    return runs


def scores_with_interval(final_laps: pd.DataFrame, column: str) -> tuple[float, float, float]:
    """Interquartile mean of S over runs and tracks, with its 95 % interval."""
    matrix = score_matrix(final_laps, column)
    return interquartile_mean(matrix), *bootstrap_interval(matrix)


def median_reached(values: pd.Series) -> tuple[float, int]:
    """Median over runs, where a run that did not get there counts as infinite; and how many got there."""
    return float(np.quantile(values, 0.5, method="lower")), int(np.isfinite(values).sum())
