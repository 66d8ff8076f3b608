"""Algorithm 1 line by line, with a stub actor and a stub predictor.

The actor's actions are sums of powers of two, which SB3's scaling and unscaling returns to the bit.
"""

from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from stubs import Constant, StubPredictor, above, deny, guided, never, sample
from toy import GUIDED, Line, build, nearby

from sb3_sap import DDPGAP, DDPGAPCE2


@pytest.mark.parametrize("steps_taken", [10, 19])
def test_until_t_k_the_action_is_the_actors_plus_noise_without_a_query(steps_taken):  # lines 1-4
    model = guided([[0.125]], never, learning_starts=10, t_k=20, action_noise=Constant(0.25))
    model.num_timesteps = steps_taken  # the step about to be taken is t = steps_taken + 1 <= t_k
    action, scaled = sample(model, model.action_noise)
    assert action == scaled == pytest.approx(0.375)


def test_uniform_warm_up_lies_within_t_k():
    model = guided([[0.125]], never, learning_starts=10, t_k=20, action_noise=Constant(0.0))
    model.num_timesteps = 9
    model.action_space.sample = lambda: np.float32([0.75])
    assert sample(model, model.action_noise)[1] == 0.75


def test_after_t_k_the_action_has_no_noise():  # line 2
    model = guided([[0.125]], above(0), learning_starts=10, t_k=20, action_noise=Constant(0.25))
    model.num_timesteps = 20
    action, scaled = sample(model, model.action_noise)
    assert action == scaled == np.float32(0.125)
    assert model.action_noise.calls == 0
    assert model.predictor.queries == [1]


def test_after_t_k_there_is_no_uniform_warm_up():
    model = guided([[0.125]], above(0), learning_starts=10, t_k=5)
    model.num_timesteps = 5
    model.action_space.sample = Mock(side_effect=AssertionError)
    assert sample(model)[1] == np.float32(0.125)


def test_after_guidance_end_the_base_algorithm_explores_with_its_noise():
    model = guided([[0.125]], never, learning_starts=10, t_k=20, guidance_end=50, action_noise=Constant(0.25))
    model.num_timesteps = 50
    model.action_space.sample = Mock(side_effect=AssertionError)  # no second warm-up
    assert sample(model, model.action_noise)[1] == pytest.approx(0.375)
    model.num_timesteps, model.predictor = 49, StubPredictor(above(0), True)
    assert sample(model, model.action_noise)[1] == np.float32(0.125)
    assert model.predictor.queries == [1]


def test_guidance_end_counts_the_steps_of_all_learns():
    model = build(DDPGAP, guidance_end=30).learn(20)
    assert not model.guidance_ended
    model.learn(10)
    assert model.guidance_ended


def test_predictor_is_not_queried_with_alpha_zero():  # line 5
    action, scaled = sample(guided([[-0.25]], never, alpha=0.0))
    assert action == scaled == np.float32(-0.25)


def test_predictor_is_not_queried_before_its_first_fit():
    action, scaled = sample(guided([[-0.25]], never, fitted=False))
    assert action == scaled == np.float32(-0.25)


def test_permissible_action_is_executed_unchanged():  # lines 6-7
    model = guided([[0.125]], above(0))
    action, scaled = sample(model)
    assert action == scaled == np.float32(0.125)
    assert model.predictor.queries == [1]


def test_logit_of_zero_is_not_permissible():
    assert sample(guided([[0.25]], above(0.25)))[1] > 0.25


def test_rejected_action_is_replaced_by_a_permissible_candidate():  # lines 8-11
    model = guided([[-0.25]], above(0.5))
    action, scaled = sample(model)
    assert 0.5 < scaled.item() <= 1  # only the last of the four strata of [-1, 1] is permissible
    np.testing.assert_allclose(action, scaled, rtol=1e-6)
    assert model.predictor.queries == [1, 4]


def test_replacement_is_a_random_one_of_candidates_that_cover_the_action_space():  # lines 8 and 11
    model = guided([[-0.25]] * 4000, above(0))
    scaled = sample(model)[1]
    assert scaled.min() > 0
    # The third and fourth stratum are equally likely: 2000 each, standard deviation 32.
    assert np.sum(scaled > 0.5) == pytest.approx(2000, abs=130)
    counts, _ = np.histogram(scaled, bins=8, range=(0, 1))
    assert counts == pytest.approx([500] * 8, abs=85)


def test_without_permissible_candidates_the_actors_action_is_executed():  # line 10
    model = guided([[-0.25]], deny)
    action, scaled = sample(model)
    assert action == scaled == np.float32(-0.25)
    assert model.predictor.queries == [1, 4]
    assert model.logger.name_to_value["sap/fallback_rate"] == 1


def test_alpha_is_the_probability_of_querying_the_predictor():  # line 5
    scaled = sample(guided([[-0.25]] * 4000, above(0), alpha=0.3))[1]
    assert np.sum(scaled > 0) == pytest.approx(1200, abs=116)  # 4 standard deviations


def test_candidates_of_all_environments_are_evaluated_in_one_call():
    # Permissible actions have the sign of the environment's own observation; environment 2 has none.
    model = guided(
        [[-0.5], [-0.375], [0.25], [0.5], [0.125]],
        lambda obs, actions: actions[:, 0] * obs[:, 0],
        obs=[[1, 0], [-1, 0], [0, 0], [-1, 0], [1, 0]],
    )
    action, scaled = sample(model)
    assert scaled[0] > 0
    assert scaled[1] == np.float32(-0.375)
    assert scaled[2] == np.float32(0.25)
    assert scaled[3] < 0
    assert scaled[4] == np.float32(0.125)
    np.testing.assert_allclose(action, scaled, rtol=1e-6)
    assert model.predictor.queries == [5, 3 * 4]
    values = model.logger.name_to_value
    assert values["sap/consultation_rate"] == 1
    assert values["sap/rejection_rate"] == pytest.approx(3 / 5)
    assert values["sap/fallback_rate"] == pytest.approx(1 / 3)


def test_only_actions_that_were_queried_are_replaced_each_by_its_own_observation():
    signs = np.where(np.arange(200) % 3 == 0, 1.0, -1.0)
    obs = np.stack([signs, np.zeros(200)], axis=1)
    actor = -0.125 * signs[:, None]  # always wrong
    model = guided(actor, lambda obs, actions: actions[:, 0] * obs[:, 0], alpha=0.5, obs=obs)
    scaled = sample(model)[1][:, 0]
    kept = scaled == np.float32(actor[:, 0])
    assert 70 < kept.sum() < 130
    assert (np.sign(scaled[~kept]) == signs[~kept]).all()
    rate = model.logger.name_to_value["sap/consultation_rate"]
    assert model.predictor.queries == [round(200 * rate), 4 * round(200 * rate)]
    assert (~kept).sum() == round(200 * rate)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_replacement_respects_dimensions_and_bounds_of_the_action_space(dtype):
    # Scaled, the actor's (4, 6) of [2, 10]² is (-1/2, 0); permissible is where both are above 1/2: one stratum each.
    env = Line(dim=2, low=2.0, high=10.0, action_dtype=dtype)
    model = guided([[4, 6]] * 300, lambda obs, actions: actions.min(dim=1).values - 0.5, env=env)
    action, scaled = sample(model)
    replaced = scaled[:, 0] != -0.5
    # Latin hypercube: the last stratum of both dimensions meets with probability 1/4.
    assert replaced.sum() == pytest.approx(75, abs=30)
    assert (scaled[replaced] > 0.5).all()
    np.testing.assert_array_equal(scaled[~replaced], [[-0.5, 0]] * (~replaced).sum())
    np.testing.assert_allclose(action, 6 + 4 * scaled, rtol=1e-6)
    assert action.shape == scaled.shape == (300, 2)


def test_action_space_of_shape_2_by_2_is_guided():
    env = Line()
    env.action_space = spaces.Box(-1, 1, (2, 2), np.float32)
    actor = np.full((3, 2, 2), -0.2)
    model = guided(actor, lambda obs, actions: actions[:, 3], env=env)
    scaled = sample(model)[1]
    assert scaled.shape == (3, 2, 2)
    assert (scaled[:, 1, 1] > 0).all()


def test_float64_action_space_trains():
    model = build(DDPGAP, Line(action_dtype=np.float64), alpha=1.0, alpha_low=1.0).learn(80)
    assert model.predictor.fitted


@pytest.mark.parametrize("low", [-1.0, 3.0])
@pytest.mark.parametrize("algorithm", GUIDED)
def test_both_buffers_hold_the_executed_action(algorithm, low):
    env = DummyVecEnv([lambda: Line(dim=2, low=low, high=5.0)] * 2)
    model = build(algorithm, env, alpha=1.0, alpha_low=1.0, n_candidates=8, t_k=10)
    model.predictor = StubPredictor(lambda obs, actions: actions[:, 0] - 0.6)
    model.learn(80)
    assert model.predictor.queries
    stored = model.replay_buffer.actions[:40]  # (40, 2 environments, 2 dimensions)
    executed = np.stack([inner.executed for inner in env.envs], axis=1)
    np.testing.assert_allclose(low + (stored + 1) / 2 * (5 - low), executed, rtol=1e-5, atol=1e-5)
    assert (stored[10:, :, 0] > 0.6).mean() > 0.8  # guidance was active
    knowledge = model.replay_buffer.knowledge
    in_k = np.concatenate([knowledge.actions[knowledge._offset[p] :][: len(s)] for p, s in knowledge.parts.items()])
    np.testing.assert_array_equal(np.sort(in_k, axis=0), np.sort(stored.reshape(-1, 2), axis=0))


def test_predict_returns_the_actors_action_without_a_query():
    model = build(DDPGAP, alpha=1.0, alpha_low=1.0).learn(30)
    model.predictor = StubPredictor(never)
    obs = np.array([0.3, 0.1], dtype=np.float32)
    expected = model.actor(th.tensor(obs[None])).detach().numpy()[0]
    np.testing.assert_allclose(model.predict(obs)[0], expected, atol=1e-6)


# ---------------------------------------------------------------- whole runs


def test_t_k_defaults_to_learning_starts():
    assert build(DDPGAP, learning_starts=17).noise_steps == 17
    assert build(DDPGAP, learning_starts=17, t_k=0).noise_steps == 0
    assert build(DDPGAP, learning_starts=17, t_k=40, action_noise=Constant(0.0)).noise_steps == 40


def test_noise_ends_at_t_k_and_does_not_return_in_a_second_learn():
    model = build(DDPGAP, learning_starts=10, t_k=20, action_noise=Constant(0.1), alpha=1e-9)
    predicted = []
    predict = model.predict
    model.predict = lambda *args, **kwargs: predicted.append(model.num_timesteps) or predict(*args, **kwargs)
    model.learn(30)
    assert model.action_noise.calls == 20  # also while SB3 draws uniformly
    assert predicted == list(range(10, 30))
    predicted.clear()
    model.learn(5)
    assert model.num_timesteps == 5
    assert model.action_noise.calls == 20
    assert predicted == list(range(5))
    model.learn(5, reset_num_timesteps=False)
    assert model.action_noise.calls == 20


def test_without_guidance_noise_goes_on_after_t_k():
    model = build(DDPGAP, learning_starts=10, t_k=20, action_noise=Constant(0.1), alpha=0.0).learn(30)
    assert model.action_noise.calls == 30
    model.learn(5)  # without another uniform warm-up
    assert model.action_noise.calls == 35


def test_t_k_counts_the_steps_of_all_learns():
    model = build(DDPGAP, learning_starts=0, t_k=20, action_noise=Constant(0.1), alpha=1e-9)
    for _ in range(2):
        model.learn(8)
    model.learn(8, reset_num_timesteps=False)
    assert model.action_noise.calls == 20


def test_candidates_come_from_the_interval_of_the_constraint():
    # The predictor permits actions above -0.5, the constraint those within 0.5 of the last action.
    model = guided([[-0.75]] * 500, above(-0.5), algorithm=DDPGAPCE2, constraint=nearby)
    model._previous = [(np.zeros(2), np.float32([0.5]))] * 500
    scaled = sample(model)[1]
    assert scaled.min() >= 0
    assert model.predictor.queries == [500]  # the uniform draw from [0, 1] is already permissible
    model.predictor.logits_of = above(0.75)
    model.predictor.queries.clear()
    scaled = sample(model)[1]
    # Of the four strata of [0, 1] the last, [0.75, 1], is permissible.
    assert scaled.min() > 0.75
    assert model.predictor.queries[0] == 500
    assert model.predictor.queries[1] == pytest.approx(4 * 375, abs=160)
