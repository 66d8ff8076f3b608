"""Statistics of few runs, compared with numbers that can be computed in the head."""

import numpy as np
import pytest

from sb3_sap.evaluation.statistics import bootstrap_difference, bootstrap_interval, interquartile_mean


def test_interquartile_mean_drops_a_quarter_at_each_end():
    assert interquartile_mean(np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0], [6.0, 1000.0]])) == 3.5


def test_interval_of_equal_runs_is_a_point():
    assert bootstrap_interval(np.full((10, 4), 0.9)) == pytest.approx((0.9, 0.9))


def test_interval_contains_the_mean_and_resamples_within_tasks():
    scores = np.random.default_rng(0).normal(0.5, 0.1, (10, 4))
    low, high = bootstrap_interval(scores)
    assert low < interquartile_mean(scores) < high
    # If only tasks differ from each other, every resample is the same.
    assert bootstrap_interval(np.tile([0.0, 1.0, 2.0, 3.0], (10, 1))) == (1.5, 1.5)


def test_difference_of_shifted_runs_is_the_shift():
    scores = np.random.default_rng(0).normal(0.5, 0.1, (10, 3))
    difference, low, high = bootstrap_difference(scores + 1, scores)
    assert difference == pytest.approx(1)
    assert low < 1 < high
    assert bootstrap_difference(np.full((5, 2), 0.9), np.full((5, 2), 0.4)) == pytest.approx((0.5, 0.5, 0.5))
