"""Guided prediction and the choice among candidates, by hand."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_exploration import StubPredictor, above, deny, guided, never, sample
from toy import GUIDED, Line, build

from sb3_sap import DDPGAP, SACAP, GuidedPolicy
from sb3_sap.guidance.candidates import SELECTIONS, choose
from sb3_sap.guidance.values import q_values


def predicting(rule, actor=0.0, env=None, **settings):
    """A trained model whose actor always answers ``actor`` (scaled) and whose E follows ``rule``."""
    model = build(DDPGAP, env, **settings).learn(30)
    model.predictor = StubPredictor(rule)
    with th.no_grad():
        for parameter in model.actor.mu[-2].parameters():
            parameter.zero_()
        model.actor.mu[-2].bias.fill_(np.arctanh(actor))
    return model


OBS = np.array([[0.3, 0.1], [-0.2, 0.5]], dtype=np.float32)


def test_unasked_the_actor_alone_answers():
    np.testing.assert_allclose(predicting(never, 0.25).predict(OBS)[0], [[0.25], [0.25]], atol=1e-6)


def test_a_rejected_action_moves_to_the_nearest_permissible_candidate():
    model = predicting(above(0.5), n_candidates=100)
    actions, _ = model.predict(OBS, deterministic=True, guided=True)
    assert actions.shape == (2, 1)
    assert ((actions > 0.5) & (actions <= 0.54)).all()  # within two strata of width 0.02
    np.testing.assert_array_equal(actions, model.predict(OBS, guided=True)[0])


def test_others_in_a_batch_change_nothing():
    model = predicting(above(0.5), env=Line(dim=2), n_candidates=20)
    batch = np.repeat(OBS, 3, axis=0)
    alone = [model.predict(obs, deterministic=True, guided=True)[0] for obs in batch]
    np.testing.assert_array_equal(model.predict(batch, deterministic=True, guided=True)[0], alone)


def test_raw_observations_cannot_be_had_without_their_statistics(tmp_path):
    asked = []

    def rule(obs, actions):
        asked.append(obs)
        return np.ones(len(actions), dtype=bool)

    env = VecNormalize(DummyVecEnv([Line]))
    build(DDPGAP, env, permissible_actions=rule).learn(30).save(tmp_path / "model")
    asked.clear()
    with pytest.raises(ValueError, match=r"load\(path, env=...\)"):
        DDPGAP.load(tmp_path / "model").predict(OBS, guided=True)
    model = DDPGAP.load(tmp_path / "model", env=env, permissible_actions=rule)
    model.predict(env.normalize_obs(OBS), guided=True)
    np.testing.assert_allclose(asked[-1][[0, -1]], OBS, atol=1e-5)


def test_a_permissible_action_is_the_actors_own_to_the_bit():
    model = predicting(above(0.0), 0.3)
    np.testing.assert_array_equal(model.predict(OBS, guided=True)[0], model.predict(OBS)[0])


def test_without_a_permissible_candidate_the_actor_decides():
    model = predicting(deny, 0.3)
    np.testing.assert_array_equal(model.predict(OBS, guided=True)[0], model.predict(OBS)[0])


def test_each_row_by_itself_and_a_single_observation():
    model = predicting(lambda obs, actions: actions[:, 0] * obs[:, 0], 0.25)
    actions, _ = model.predict(OBS, guided=True)
    assert actions[0] == pytest.approx(0.25)
    assert actions[1] < 0
    single, _ = model.predict(OBS[1], guided=True)
    assert single.shape == (1,)
    assert single < 0


def test_type_2_needs_no_fitted_predictor():
    model = build(DDPGAP, permissible_actions=lambda obs, actions: actions[:, 0] > 0.5)
    assert not model.predictor.fitted
    assert (model.predict(OBS, guided=True)[0] > 0.5).all()


def test_type_2_sees_raw_observations():
    env = VecNormalize(DummyVecEnv([lambda: Line(low=2.0, high=10.0)]))
    seen = []

    def rule(obs, actions):
        seen.append(obs)
        return actions[:, 0] > 8

    model = build(DDPGAP, env, permissible_actions=rule).learn(30)
    raw = np.array([[0.5, 0.3]], dtype=np.float32)
    seen.clear()
    actions, _ = model.predict(env.normalize_obs(raw), guided=True)
    assert actions > 8
    np.testing.assert_allclose(seen[0], np.repeat(raw, 129, axis=0), atol=1e-5)


@pytest.mark.parametrize("algorithm", GUIDED)
def test_the_wrapper_serves_evaluate_policy(algorithm):
    env = Line()
    model = build(algorithm, env).learn(60)
    model.predictor = StubPredictor(above(0.5))
    env.executed.clear()
    evaluate_policy(GuidedPolicy(model), model.get_env(), n_eval_episodes=1)
    assert (np.array(env.executed) > 0.5).all()


# ---------------------------------------------------------------- line 11


def test_choose():
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
def test_selection_by_name(selection, low, high):
    scaled = sample(guided([[-0.25]] * 20, above(0), n_candidates=100, candidate_selection=selection))[1]
    assert ((scaled > low) & (scaled <= high)).all()
    assert (scaled.std() > 0.1) == (selection == "random")


@pytest.mark.parametrize("algorithm", GUIDED)
def test_highest_q_is_the_critics_choice(algorithm):
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
        assert chosen >= q.max() - (q.max() - q.min()) * 0.15 - 1e-6  # the candidates are a grid of their own


def test_critics_statistics_stand_still():
    model = build(GUIDED[-1]).learn(60)
    before = {name: value.clone() for name, value in model.critic.named_buffers()}
    assert before
    model.policy.set_training_mode(True)
    q_values(model, th.as_tensor(OBS), th.zeros(2, 1))
    assert all(th.equal(value, before[name]) for name, value in model.critic.named_buffers())


def test_an_unknown_selection_is_refused():
    with pytest.raises(ValueError, match=r"^`candidate_selection` must be one of 'random', .* but is 'best'"):
        build(SACAP, candidate_selection="best")
    assert SELECTIONS[0] == "random"
