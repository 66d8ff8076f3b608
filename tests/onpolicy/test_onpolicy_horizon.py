"""Mistakes that show later, in the rollouts of on-policy algorithms."""

import numpy as np
import pytest
from gymnasium import spaces
from rollouts import assert_same_learning, build_on_policy
from scripted import FIRST, SECOND, THIRD, envs, expected, labels_of, steps_of
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sap import A2CAP, PPOAP, RecurrentPPOAP


@pytest.mark.parametrize("algorithm", [PPOAP, RecurrentPPOAP])
@pytest.mark.parametrize("scripts", [(FIRST,), (FIRST, SECOND, THIRD)])
def test_penalty_reaches_the_rewards_of_the_rollout(algorithm, scripts):
    settings = {"ap_function": None, "event": "cost", "horizon": 3, "gamma": 0.0}
    plain, model = (
        build_on_policy(algorithm, envs(*scripts), **settings, penalty=c).learn(16 * len(scripts)) for c in (0.0, 4.0)
    )
    labels = expected(scripts, 16, 3, "cost")
    assert labels_of(model) == labels
    observed = steps_of(model.rollout_buffer.observations.reshape(len(scripts), 16, 3).swapaxes(0, 1))
    added = (model.rollout_buffer.rewards - plain.rollout_buffer.rewards).reshape(-1, len(scripts))
    np.testing.assert_allclose(added, [[-4.0 * (labels.get(p) is False) for p in row] for row in observed])
    returns = model.rollout_buffer.returns.reshape(len(scripts), -1).T  # with γ = 0 they are the rewards
    np.testing.assert_allclose(returns, model.rollout_buffer.rewards.reshape(-1, len(scripts)), atol=1e-5)


def test_labels_of_the_next_rollout_change_no_reward_of_it():
    model = build_on_policy(A2CAP, envs(THIRD), ap_function=None, event="cost", horizon=2, penalty=4.0, n_steps=2)
    model.learn(4)  # steps 2 and 3 have costs; step 1 was in the first rollout
    np.testing.assert_array_equal(model.rollout_buffer.rewards.ravel(), [6.0, 6.0])
    assert labels_of(model) == {(0, 0, 0): True, (0, 0, 1): False, (0, 0, 2): False, (0, 0, 3): False}


def test_agreement_is_that_of_the_labels_which_are_known():
    model = build_on_policy(PPOAP, envs(THIRD), ap_function=None, event="cost", horizon=2).learn(16)
    assert len(model.agreement._labels) == len(labels_of(model)) == len(expected([THIRD], 16, 2, "cost"))


def test_late_penalty_is_in_units_of_normalised_rewards():
    env = VecNormalize(envs(THIRD))
    settings = {"ap_function": None, "event": "cost", "horizon": 2}
    plain = build_on_policy(PPOAP, VecNormalize(envs(THIRD)), **settings).learn(16)
    model = build_on_policy(PPOAP, env, **settings, penalty=1.0).learn(16)
    added = (model.rollout_buffer.rewards - plain.rollout_buffer.rewards).ravel()
    # The rewards of the others may differ by rounding.
    assert [i for i, x in enumerate(added) if x < -1e-3] == [1, 2, 3, 9, 10, 11]
    assert labels_of(model) == expected([THIRD], 16, 2, "cost")
    assert added.min() == pytest.approx(added[1], rel=0.5)


def test_joint_actions_of_on_policy_algorithms_are_labelled_late():
    def ap_function(obs, actions, next_obs):
        assert actions.shape == (len(obs), 2)
        assert next_obs.shape == (len(obs), 2, 3)
        return actions[:, 0] > 0

    env = envs(FIRST, SECOND, action_space=spaces.MultiDiscrete([3, 2]))
    model = build_on_policy(PPOAP, env, ap_function=ap_function, horizon=2).learn(32)
    kept = model.knowledge.actions[model.knowledge._filled()]
    assert model.knowledge.seen == [(kept[:, 0] == 0).sum(), (kept[:, 0] > 0).sum()]


def test_penalty_that_would_come_after_every_rollout_is_refused():
    with pytest.raises(ValueError, match=r"^`penalty` = 1.0 with `horizon` = 9 would come after the end of rollouts"):
        build_on_policy(A2CAP, envs(), ap_function=None, event="cost", horizon=9, n_steps=8, penalty=1.0)


def test_horizon_of_one_is_the_model_without_the_argument_to_the_bit():
    plain, given = (build_on_policy(PPOAP, penalty=1.0, **extra).learn(64) for extra in ({}, {"horizon": 1}))
    assert_same_learning(plain, given)


@pytest.mark.parametrize("goes_on", [True, False])
def test_pending_actions_are_saved_with_the_model(tmp_path, goes_on):
    long = [(100, True, (17,))]
    settings = {"ap_function": None, "event": "cost", "horizon": 4}
    build_on_policy(PPOAP, env := envs(long), **settings).learn(16).save(tmp_path / "model")
    loaded = PPOAP.load(tmp_path / "model", env=env, force_reset=not goes_on)
    assert len(loaded.labelled.pending) == 3
    loaded.learn(16, reset_num_timesteps=False)
    found = {place: label for place, label in labels_of(loaded).items() if place[1] == 0 and place[2] > 12}
    if goes_on:
        assert [found[0, 0, t] for t in range(13, 20)] == [True, False, False, False, False, True, True]
    else:
        assert found == {}
