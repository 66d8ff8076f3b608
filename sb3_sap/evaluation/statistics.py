"""Statistics of few, skewed runs: the interquartile mean and its interval, as in Agarwal et al. (2021)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from sb3_sap.common.arrays import FloatArray


def interquartile_mean(scores: np.ndarray[Any, Any]) -> float:
    """Mean of the middle half of the scores, (runs, tasks), of all runs on all tasks."""
    return float(stats.trim_mean(scores, 0.25, axis=None))


def bootstrap_interval(
    scores: FloatArray, confidence: float = 0.95, resamples: int = 2_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the interquartile mean, resampling runs within each task (stratified bootstrap).

    :param scores: (runs, tasks)
    :return: lower and upper end
    """
    means = _resampled_means(np.random.default_rng(seed), scores, resamples)
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def probability_of_improvement(
    ours: FloatArray, theirs: FloatArray, confidence: float = 0.95, resamples: int = 2_000, seed: int = 0
) -> tuple[float, float, float]:
    """How probably a run of ours beats one of theirs on a task drawn at random, ties counting half; with its interval.

    :param ours: (runs, tasks)
    :param theirs: (runs, tasks), of the same tasks
    :return: the probability, and the ends of its interval
    """
    rng = np.random.default_rng(seed)

    def resampled(scores: FloatArray) -> FloatArray:
        n_runs, n_tasks = scores.shape
        chosen: FloatArray = scores[rng.integers(n_runs, size=(resamples, n_runs, n_tasks)), np.arange(n_tasks)]
        return chosen

    tail = (1 - confidence) / 2
    low, high = np.quantile(_share_of_wins(resampled(ours), resampled(theirs)), [tail, 1 - tail])
    return float(_share_of_wins(ours, theirs)), float(low), float(high)


def _share_of_wins(ours: FloatArray, theirs: FloatArray) -> Any:
    """Share of the pairs of runs that ours win, mean over tasks; scores are (…, runs, tasks)."""
    difference = ours[..., :, None, :] - theirs[..., None, :, :]  # (…, our runs, their runs, tasks)
    return ((np.sign(difference) + 1) / 2).mean(axis=(-3, -2, -1))


def bootstrap_difference(
    scores: FloatArray, others: FloatArray, confidence: float = 0.95, resamples: int = 2_000, seed: int = 0
) -> tuple[float, float, float]:
    """Difference of two interquartile means with its interval; both are resampled, each within its tasks.

    :param scores: (runs, tasks)
    :param others: (runs, tasks), what is subtracted
    :return: the difference, and the ends of its interval
    """
    rng = np.random.default_rng(seed)
    differences = _resampled_means(rng, scores, resamples) - _resampled_means(rng, others, resamples)
    tail = (1 - confidence) / 2
    low, high = np.quantile(differences, [tail, 1 - tail])
    return interquartile_mean(scores) - interquartile_mean(others), float(low), float(high)


def _resampled_means(rng: np.random.Generator, scores: FloatArray, resamples: int) -> FloatArray:
    n_runs, n_tasks = scores.shape
    chosen = rng.integers(n_runs, size=(resamples, n_runs, n_tasks))
    resampled = scores[chosen, np.arange(n_tasks)]  # (resamples, runs, tasks)
    means: FloatArray = stats.trim_mean(resampled.reshape(resamples, -1), 0.25, axis=1)
    return means
