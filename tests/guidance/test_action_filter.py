"""`predict(guided=True)` and `GuidedPolicy`, with a stub predictor."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stubs import StubPredictor, above, deny, never
from toy import GUIDED, Line, build

from sb3_sap import DDPGAP, GuidedPolicy


def predicting(logits_of, actor=0.0, env=None, **settings):
    """A trained model whose actor always returns ``actor`` (scaled) and whose predictor has the given logits."""
    model = build(DDPGAP, env, **settings).learn(30)
    model.predictor = StubPredictor(logits_of)
    with th.no_grad():
        for parameter in model.actor.mu[-2].parameters():
            parameter.zero_()
        model.actor.mu[-2].bias.fill_(np.arctanh(actor))
    return model


OBS = np.array([[0.3, 0.1], [-0.2, 0.5]], dtype=np.float32)


def test_predict_returns_the_actors_action_unless_guided():
    np.testing.assert_allclose(predicting(never, 0.25).predict(OBS)[0], [[0.25], [0.25]], atol=1e-6)


def test_rejected_action_is_replaced_by_the_nearest_permissible_candidate():
    model = predicting(above(0.5), n_candidates=100)
    actions, _ = model.predict(OBS, deterministic=True, guided=True)
    assert actions.shape == (2, 1)
    assert ((actions > 0.5) & (actions <= 0.54)).all()  # within two strata of width 0.02
    np.testing.assert_array_equal(actions, model.predict(OBS, guided=True)[0])


def test_guided_action_is_the_same_alone_and_in_a_batch():
    model = predicting(above(0.5), env=Line(dim=2), n_candidates=20)
    batch = np.repeat(OBS, 3, axis=0)
    alone = [model.predict(obs, deterministic=True, guided=True)[0] for obs in batch]
    np.testing.assert_array_equal(model.predict(batch, deterministic=True, guided=True)[0], alone)


def test_guided_prediction_without_the_statistics_of_vec_normalize_is_refused(tmp_path):
    seen = []

    def allow(obs, actions):
        seen.append(obs)
        return np.ones(len(actions), dtype=bool)

    env = VecNormalize(DummyVecEnv([Line]))
    build(DDPGAP, env, permissible_actions=allow).learn(30).save(tmp_path / "model")
    seen.clear()
    with pytest.raises(ValueError, match=r"load\(path, env=...\)"):
        DDPGAP.load(tmp_path / "model").predict(OBS, guided=True)
    model = DDPGAP.load(tmp_path / "model", env=env, permissible_actions=allow)
    model.predict(env.normalize_obs(OBS), guided=True)
    np.testing.assert_allclose(seen[-1][[0, -1]], OBS, atol=1e-5)


def test_permissible_action_is_returned_to_the_bit():
    model = predicting(above(0.0), 0.3)
    np.testing.assert_array_equal(model.predict(OBS, guided=True)[0], model.predict(OBS)[0])


def test_without_a_permissible_candidate_the_actors_action_is_returned():
    model = predicting(deny, 0.3)
    np.testing.assert_array_equal(model.predict(OBS, guided=True)[0], model.predict(OBS)[0])


def test_rows_are_filtered_separately_and_a_single_observation_gives_a_single_action():
    model = predicting(lambda obs, actions: actions[:, 0] * obs[:, 0], 0.25)
    actions, _ = model.predict(OBS, guided=True)
    assert actions[0] == pytest.approx(0.25)
    assert actions[1] < 0
    single, _ = model.predict(OBS[1], guided=True)
    assert single.shape == (1,)
    assert single < 0


def test_permissible_actions_filter_before_the_first_fit():
    model = build(DDPGAP, permissible_actions=lambda obs, actions: actions[:, 0] > 0.5)
    assert not model.predictor.fitted
    assert (model.predict(OBS, guided=True)[0] > 0.5).all()


def test_permissible_actions_get_raw_observations_in_guided_prediction():
    env = VecNormalize(DummyVecEnv([lambda: Line(low=2.0, high=10.0)]))
    seen = []

    def allow(obs, actions):
        seen.append(obs)
        return actions[:, 0] > 8

    model = build(DDPGAP, env, permissible_actions=allow).learn(30)
    raw = np.array([[0.5, 0.3]], dtype=np.float32)
    seen.clear()
    actions, _ = model.predict(env.normalize_obs(raw), guided=True)
    assert actions > 8
    np.testing.assert_allclose(seen[0], np.repeat(raw, 129, axis=0), atol=1e-5)


@pytest.mark.parametrize("algorithm", GUIDED)
def test_guided_policy_works_with_evaluate_policy(algorithm):
    env = Line()
    model = build(algorithm, env).learn(60)
    model.predictor = StubPredictor(above(0.5))
    env.executed.clear()
    evaluate_policy(GuidedPolicy(model), model.get_env(), n_eval_episodes=1)
    assert (np.array(env.executed) > 0.5).all()
