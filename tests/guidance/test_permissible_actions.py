"""Type-2 permissibility: actions that `permissible_actions` forbids are never executed, guided or not."""

import numpy as np
import pytest
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import GUIDED, Line, build

from sb3_sap import DDPG, DDPGAP, DQNAP, QRDQNAP, SACAP, ConstrainedExplorationMixin


def only_right(obs, actions):
    """Of the scaled actions of :class:`Line`, those above 1/2."""
    return actions[:, 0] > 0.5


def upper_quarter(obs, actions):
    """The same where the action space is [2, 10]."""
    return actions[:, 0] > 8


def nothing(obs, actions):
    return np.zeros(len(actions), dtype=bool)


@pytest.mark.parametrize("algorithm", [DDPG, *GUIDED])
def test_forbidden_actions_are_never_executed(algorithm):
    env = DummyVecEnv([lambda: Line(low=2.0, high=10.0)] * 2)
    settings = {"constraint": None} if algorithm in GUIDED else {}
    build(algorithm, env, permissible_actions=upper_quarter, **settings).learn(80)
    executed = np.array([inner.executed for inner in env.envs])
    assert (executed > 8).all()
    assert executed.std() > 0.1  # drawn, not clipped to the border


def test_replacements_are_uniform_over_the_allowed_actions():
    env = Line(horizon=10_000)
    build(DDPG, env, permissible_actions=only_right, learning_starts=2000, buffer_size=2000).learn(2000)
    counts, _ = np.histogram(np.array(env.executed), bins=5, range=(0.5, 1))
    assert counts == pytest.approx([400] * 5, abs=72)  # 4 standard deviations


def test_without_an_allowed_candidate_the_action_is_executed_unchanged():
    env, plain = Line(), Line()
    build(DDPG, env, permissible_actions=nothing).learn(40)
    build(DDPG, plain).learn(40)
    np.testing.assert_array_equal(env.executed, plain.executed)


def test_permissible_actions_that_allow_everything_change_no_bit():
    env, plain = Line(), Line()
    build(DDPGAP, env, permissible_actions=lambda obs, actions: np.ones(len(actions), bool)).learn(80)
    build(DDPGAP, plain).learn(80)
    np.testing.assert_array_equal(env.executed, plain.executed)


def test_permissible_actions_and_constraint_hold_together():
    env = Line()
    build(
        DDPG, env, constraint=lambda *_: (np.float32([-1]), np.float32([0.75])), permissible_actions=only_right
    ).learn(60)
    executed = np.array(env.executed)[1:]  # a constraint is applied from the second step of each episode
    inside = (executed > 0.5) & (executed <= 0.75)
    assert inside[np.arange(1, 60) % 10 != 0].all()


def test_permissible_actions_get_raw_observations_and_actions_in_env_units():
    seen = []

    def spy(obs, actions):
        seen.append((obs.copy(), actions.copy()))
        return np.ones(len(actions), bool)

    env = VecNormalize(DummyVecEnv([lambda: Line(low=2.0, high=10.0)] * 2))
    model = build(SACAP, env, permissible_actions=spy).learn(40)
    times = np.concatenate([obs[:, 1] for obs, actions in seen if len(actions) == 2])
    np.testing.assert_allclose(times, np.repeat(np.tile(np.arange(10) / 10, 2), 2), atol=1e-6)
    for _, actions in seen:
        assert ((actions >= 2) & (actions <= 10)).all()
    assert model.num_timesteps == 40


def test_permissible_actions_get_dict_observations():
    env = Line("dict")
    build(DDPGAP, env, policy="MultiInputPolicy", permissible_actions=lambda o, a: (o["x"] * a <= 0)[:, 0]).learn(60)
    assert len(env.executed) == 60


def test_permissible_actions_given_by_name_are_saved_and_resolved_again(tmp_path):
    model = build(DDPGAP, permissible_actions="test_permissible_actions.only_right").learn(20)
    model.save(tmp_path / "model")
    env = Line()
    DDPGAP.load(tmp_path / "model", env=env).learn(20)
    assert (np.array(env.executed) > 0.5).all()


@pytest.mark.parametrize("algorithm", [DDPG, DDPGAP, DQNAP])
@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (
            lambda obs, actions: 1 / 0,
            RuntimeError,
            r"^`permissible_actions` <lambda> raised .*\(obs, actions\) of n = 1",
        ),
        (lambda obs, actions: actions, TypeError, "^`permissible_actions` <lambda> returned values of type"),
        (lambda obs, actions: np.array([True, True]), ValueError, r"returned an array of shape \(2,\) for 1 actions"),
    ],
)
def test_invalid_return_values_are_refused(algorithm, function, error, message):
    with pytest.raises(error, match=message):
        build(algorithm, permissible_actions=function).learn(30)


def rightmost(obs, actions):
    return actions.reshape(len(actions)) == 2


class ConstrainedDQN(ConstrainedExplorationMixin, DQN):
    pass


class ConstrainedQRDQN(ConstrainedExplorationMixin, QRDQN):
    pass


class ConstrainedSAC(ConstrainedExplorationMixin, SAC):
    pass


@pytest.mark.parametrize("algorithm", [DQNAP, QRDQNAP, ConstrainedDQN, ConstrainedQRDQN])
def test_permissible_actions_need_no_labels_for_discrete_actions(algorithm):
    env = Line(n_actions=3, labels=False)
    model = build(algorithm, env, permissible_actions=rightmost).learn(60)
    assert set(map(int, env.executed)) == {2}
    if algorithm in (DQNAP, QRDQNAP):
        assert not model.predictor.fitted


@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP, ConstrainedSAC])
def test_permissible_actions_need_no_labels_for_continuous_actions(algorithm):
    env = Line(labels=False)
    build(algorithm, env, permissible_actions=only_right).learn(60)
    assert (np.array(env.executed) > 0.5).all()


def test_labels_are_stored_beside_permissible_actions():
    model = build(DQNAP, permissible_actions=lambda obs, actions: np.ones(len(actions), bool)).learn(60)
    assert sum(model.replay_buffer.knowledge.seen) == 60
