"""A guide acts at first, and hands over where the agent's action has the higher value."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import CONSTRAINED, DISCRETE, GUIDED, Line, build

from sb3_sap import DDPGAP, DQNAP, SACAP


def towards(obs):
    """The controller of the line: as far as possible to the centre."""
    return -np.sign(obs[:, :1])


def beyond(obs):
    return 100 * towards(obs)


class Old:
    """An old policy, as SB3's are."""

    def predict(self, observation, *, deterministic):
        assert deterministic
        return towards(observation), None


def executed(model):
    return np.array([env.unwrapped.executed for env in model.env.envs])[..., 0]


@pytest.mark.parametrize("algorithm", [algorithm for algorithm in GUIDED if algorithm not in CONSTRAINED])
@pytest.mark.parametrize("guide", [towards, beyond, Old()], ids=["function", "beyond", "policy"])
def test_guide_acts_in_place_of_random_actions(algorithm, guide):
    model = build(algorithm, guide_policy=guide, learning_starts=20).learn(20)
    assert set(np.abs(executed(model)[0])) == {1.0}
    batch = model.replay_buffer
    assert (np.sign(batch.actions[:20, 0, 0]) == -np.sign(batch.observations[:20, 0, 0])).all()


def test_every_environment_has_its_own_action():
    model = build(SACAP, DummyVecEnv([Line] * 3), guide_policy=towards, learning_starts=30).learn(30)
    assert executed(model).shape == (3, 10)
    rows = model.replay_buffer
    assert (np.sign(rows.actions[:10]) == -np.sign(rows.observations[:10, :, :1])).all()


def test_actions_are_in_the_units_of_the_environment():
    model = build(SACAP, Line(low=-2, high=4), guide_policy=lambda obs: np.full((1, 1), 4.0), learning_starts=5).learn(
        5
    )
    assert set(executed(model)[0]) == {4.0}
    assert set(model.replay_buffer.actions[:5, 0, 0]) == {1.0}


@pytest.mark.parametrize("better", ["guide", "agent"])
def test_action_of_the_higher_value_is_executed(monkeypatch, better):
    monkeypatch.setattr(
        "sb3_sap.guidance.jump_start.q_values",
        lambda model, obs, actions: (actions[:, 0] == 1.0).float() * (1 if better == "guide" else -1),
    )
    model = build(DDPGAP, guide_policy=lambda obs: np.ones((1, 1)), guide_steps=0, learning_starts=0, alpha=0)
    model.learn(20)
    assert ((executed(model)[0] == 1.0).mean() > 0.9) == (better == "guide")


@pytest.mark.parametrize("algorithm", DISCRETE)
def test_guide_replaces_the_random_actions_of_discrete_exploration(algorithm):
    model = build(algorithm, guide_policy=lambda obs: np.full(1, 2), learning_starts=10, alpha=0, learning_rate=0.0)
    model.exploration_initial_eps = model.exploration_final_eps = 1.0
    model._setup_model()
    model.learn(50)
    actions = model.replay_buffer.actions[:50, 0, 0]
    greedy = model.policy.predict(model.replay_buffer.observations[:50, 0], deterministic=True)[0]
    assert (actions[:10] == 2).all()
    assert ((actions == 2) | (actions == greedy)).all()
    assert (greedy != 2).any()


def test_guide_ends():
    model = build(SACAP, guide_policy=lambda obs: np.ones((1, 1)), learning_starts=20, guide_end=10).learn(20)
    assert (executed(model)[0][:10] == 1.0).all()
    assert (executed(model)[0][10:] != 1.0).all()


def test_without_a_guide_nothing_changes():
    one, other = build(SACAP).learn(40), build(SACAP, guide_policy=towards, guide_end=0).learn(40)
    assert all(th.equal(a, b) for a, b in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


@pytest.mark.parametrize(
    ("algorithm", "guide", "sentence"),
    [
        (SACAP, lambda obs: np.ones(3), r"must return finite actions of shape \(1, 1\)"),
        (SACAP, lambda obs: np.full((1, 1), np.nan), "must return finite actions"),
        (DQNAP, lambda obs: np.array([7]), "outside of Discrete"),
        (DQNAP, lambda obs: np.array([0.5]), "outside of Discrete"),
    ],
)
def test_what_is_wrong_with_a_guide_is_said(algorithm, guide, sentence):
    with pytest.raises(ValueError, match=sentence):
        build(algorithm, guide_policy=guide).learn(20)


def test_guide_is_saved_and_loaded(tmp_path):
    model = build(DDPGAP, guide_policy=towards).learn(20)
    model.save(tmp_path / "model")
    assert DDPGAP.load(tmp_path / "model", Line()).guide_policy is towards
    other = DDPGAP.load(tmp_path / "model", Line(), guide_policy=beyond)
    assert other.guide_policy is beyond
