"""The candidates of Algorithm 1, which are stratified [line 8], and the choice among them [line 11]."""

import numpy as np
import pytest
import torch as th
from stubs import StubPredictor, above, guided, sample
from toy import GUIDED, build

from sb3_sap import SACAP
from sb3_sap.guidance.candidates import SELECTIONS, choose, stratified_candidates
from sb3_sap.guidance.values import q_values

OBS = np.array([[0.3, 0.1], [-0.2, 0.5]], dtype=np.float32)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_each_stratum_of_each_dimension_has_one_candidate(dim):
    low = np.float32([[-1] * dim, [0] * dim])
    high = np.float32([[1] * dim, [10] * dim])
    candidates = stratified_candidates(np.random.default_rng(0), low, high, 16)
    assert candidates.shape == (2, 16, dim)
    assert candidates.dtype == np.float32
    strata = np.floor((candidates - low[:, None]) / (high - low)[:, None] * 16)
    np.testing.assert_array_equal(np.sort(strata, axis=1), np.broadcast_to(np.arange(16)[:, None], (2, 16, dim)))


def test_strata_of_dimensions_and_rows_are_paired_at_random():
    zeros = np.zeros((2, 2), np.float32)
    candidates = stratified_candidates(np.random.default_rng(0), zeros, zeros + 1, 1000)
    for row in candidates:
        assert abs(np.corrcoef(row.T)[0, 1]) < 0.13  # 4 standard deviations
    assert abs(np.corrcoef(candidates[0, :, 0], candidates[1, :, 0])[0, 1]) < 0.13


def test_candidates_are_uniform_within_the_bounds():
    low, high = np.float32([[-0.3]]), np.float32([[0.1]])
    rng = np.random.default_rng(0)
    draws = np.concatenate([stratified_candidates(rng, low, high, 4).ravel() for _ in range(2000)])
    assert low <= draws.min() < -0.299
    assert 0.099 < draws.max() <= high
    assert np.mean(draws) == pytest.approx(-0.1, abs=0.001)
    # Each tenth of the interval, across the borders of the quarters, holds a tenth: 800, standard deviation < 27.
    counts, _ = np.histogram(draws, bins=10, range=(-0.3, 0.1))
    assert counts == pytest.approx([800] * 10, abs=108)


def test_interval_of_one_point_gives_that_point():
    point = np.float32([[0.125]])
    assert (stratified_candidates(np.random.default_rng(0), point, point, 5) == point).all()


# ---------------------------------------------------------------- line 11


def test_choice_is_the_best_or_a_random_permissible_candidate():
    candidates = np.arange(6).reshape(2, 3, 1)
    permissible = np.array([[True, False, True], [False, True, True]])
    scores = np.array([[1.0, 9.0, 2.0], [9.0, 3.0, 2.0]])
    assert choose(np.random.default_rng(0), candidates, permissible, scores).tolist() == [[2], [4]]
    drawn = [choose(np.random.default_rng(i), candidates, permissible, None).ravel().tolist() for i in range(50)]
    assert {first for first, _ in drawn} == {0, 2}
    assert {second for _, second in drawn} == {4, 5}


@pytest.mark.parametrize(
    ("selection", "low", "high"), [("nearest", 0.0, 0.02), ("most_permissible", 0.98, 1.0), ("random", 0.0, 1.0)]
)
def test_candidate_selection_takes_the_nearest_the_most_permissible_or_a_random_one(selection, low, high):
    scaled = sample(guided([[-0.25]] * 20, above(0), n_candidates=100, candidate_selection=selection))[1]
    assert ((scaled > low) & (scaled <= high)).all()
    assert (scaled.std() > 0.1) == (selection == "random")


@pytest.mark.parametrize("algorithm", GUIDED)
def test_highest_q_selection_follows_the_critic(algorithm):
    model = build(algorithm, alpha=1.0, alpha_low=1.0).learn(60)
    obs, actions = th.as_tensor(np.repeat(OBS, 2, axis=0)), th.tensor([[-0.5], [0.5], [-0.5], [0.5]])
    with th.no_grad():
        q = q_values(model, obs, actions)
    assert q.shape == (4,)
    model.candidate_selection = "highest_q"
    model.n_candidates = 50
    model.predictor = StubPredictor(above(0))
    model.predict = lambda obs, deterministic: (np.full((2, 1), -0.25, np.float32), None)
    model._last_obs, model._previous, model.num_timesteps = OBS, [None] * 2, 10_000
    scaled = model._sample_action(0, None, 2)[1]
    grid = th.linspace(0.01, 0.99, 50)[:, None]
    for row, action in zip(OBS, scaled, strict=True):
        with th.no_grad():
            q = q_values(model, th.as_tensor(np.repeat(row[None], 50, axis=0)), grid)
            chosen = q_values(model, th.as_tensor(row[None]), th.as_tensor(action[None]))
        assert chosen >= q.max() - (q.max() - q.min()) * 0.15 - 1e-6  # the candidates are not those of the grid


def test_q_values_leave_the_running_statistics_of_the_critic_unchanged():
    model = build(GUIDED[-1]).learn(60)
    before = {name: value.clone() for name, value in model.critic.named_buffers()}
    assert before
    model.policy.set_training_mode(True)
    q_values(model, th.as_tensor(OBS), th.zeros(2, 1))
    assert all(th.equal(value, before[name]) for name, value in model.critic.named_buffers())


def test_unknown_candidate_selection_is_refused():
    with pytest.raises(ValueError, match=r"^`candidate_selection` must be one of 'random', .* but is 'best'"):
        build(SACAP, candidate_selection="best")
    assert SELECTIONS[0] == "random"
