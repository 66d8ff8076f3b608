"""Action and observation spaces that an algorithm cannot use are refused in one sentence."""

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from gymnasium import spaces
from toy import ALGORITHMS, Line, build

from sb3_sap import (
    DDPG,
    DDPGAP,
    DQNAP,
    SACAP,
    ConstrainedExplorationMixin,
)
from sb3_sap.common.spaces import check_action_space

F32 = np.finfo(np.float32)


class ConstrainedDQN(ConstrainedExplorationMixin, stable_baselines3.DQN):
    pass


def with_actions(space):
    env = Line()
    env.action_space = space
    return env


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)], ids=lambda s: type(s).__name__
)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_action_space_must_be_continuous(algorithm, space):
    with pytest.raises(
        ValueError, match=rf"^{algorithm.__name__} needs an `env` with a continuous \(Box\) action space"
    ):
        build(algorithm, with_actions(space))


def test_environment_given_by_name_is_checked():
    with pytest.raises(ValueError, match=r"^DDPGAP needs an `env` with a continuous .*but this one's is Discrete"):
        DDPGAP("MlpPolicy", "CartPole-v1")


@pytest.mark.parametrize("low", [-1.0, -np.inf])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_action_space_must_be_bounded(algorithm, low):
    with pytest.raises(ValueError, match=rf"^{algorithm.__name__} needs an `env` whose actions are bounded.*inf"):
        build(algorithm, with_actions(spaces.Box(low, np.inf, (1,))))


def test_unknown_environment_raises_the_error_of_gymnasium():
    with pytest.raises(gym.error.Error, match="NoSuchEnvironment"):
        DDPGAP("MlpPolicy", "NoSuchEnvironment-v0")


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(-10, 10, (1,), np.int32), "floating-point numbers.*truncated to whole numbers"),
        (spaces.Box(0, 255, (2,), np.uint8), "floating-point numbers"),
        (spaces.Box(-F32.max, F32.max, (1,), np.float32), r"scaled to \[-1, 1\] and back.*too large"),
        (spaces.Box(np.float32([-1, -3e38]), np.float32([1, 3e38])), "scaled to"),
        (spaces.Box(1e8, 1e8 + 16, (1,), np.float32), "too close together"),
        (spaces.Box(-1e308, 1e308, (1,), np.float64), "scaled to"),
        (spaces.Box(0, 60_000, (1,), np.float16), None),
        (spaces.Box(-60_000, 60_000, (1,), np.float16), "scaled to"),
        (spaces.Box(np.float32([-1, 2]), np.float32([1, 2])), "can vary.*leave out the dimensions that are fixed"),
        (spaces.Box(-F32.max / 4, F32.max / 4, (1,), np.float32), None),
        (spaces.Box(-1, 1, (), np.float32), None),
        (spaces.Box(0, 1e-6, (2, 2), np.float32), None),
        (spaces.Box(-1e30, 1e30, (1,), np.float64), None),
    ],
    ids=str,
)
def test_action_spaces_that_cannot_be_scaled_are_refused(space, message):
    if message is None:
        check_action_space("DDPGAP", space, discrete=False)
        return
    for algorithm in (DDPG, SACAP):
        with pytest.raises(ValueError, match=f"^{algorithm.__name__} needs an `env` whose actions {message}|{message}"):
            build(algorithm, with_actions(space))


def with_observations(space):
    env = Line(n_actions=2)
    env.observation_space = space
    return env


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (with_actions(spaces.Discrete(3, start=-1)), r"actions that count from 0.*lambda a: a \+ -1.*Discrete\(3\)"),
        (with_actions(spaces.MultiDiscrete([2, 2])), "no off-policy algorithm of SB3 takes it"),
        (with_actions(spaces.MultiBinary(3)), "no off-policy algorithm of SB3 takes it"),
        (with_actions(spaces.Box(-1, 1, (1,))), r"discrete \(Discrete\).*such as SACAP"),
        (with_observations(spaces.Discrete(4, start=1)), "observations count from 0.*subtract `start`"),
        (with_observations(spaces.MultiDiscrete([3, 3], start=[0, 1])), "observations count from 0"),
        (with_observations(spaces.Dict(a=spaces.Discrete(4, start=1))), "the entry 'a' of its observation space"),
        (with_observations(spaces.Tuple([spaces.Discrete(4)])), "FlattenObservation"),
        (with_observations(spaces.Dict(a=spaces.Dict(b=spaces.Discrete(4)))), "the entry 'a'.*FlattenObservation"),
        (with_observations(spaces.Text(4)), "FlattenObservation"),
    ],
    ids=str,
)
@pytest.mark.parametrize("algorithm", [DQNAP, ConstrainedDQN])
def test_spaces_that_discrete_algorithms_cannot_use_are_refused(algorithm, env, message):
    with pytest.raises(ValueError, match=f"^{algorithm.__name__} needs .*{message}"):
        build(algorithm, env)


def test_shift_of_discrete_actions_named_in_the_error_works():
    env = with_actions(spaces.Discrete(3, start=-1))
    env.step = lambda a: executed.append(int(a)) or (np.zeros(2, np.float32), 0.0, False, False, {"permissible": a > 0})
    executed = []
    build(DQNAP, gym.wrappers.TransformAction(env, lambda a: a + -1, spaces.Discrete(3))).learn(40)
    assert set(executed) == {-1, 0, 1}
