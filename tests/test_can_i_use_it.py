"""The features that docs/can_i_use_it.md lists, tried with every algorithm."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import ALGORITHMS, DISCRETE, Line, build

from sb3_sap import DDPGAP, CrossQAP

EVERY = (*ALGORITHMS, *DISCRETE)


class Picture(gym.ObservationWrapper):
    """A picture, 36 by 36, whose brightness is x."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (36, 36, 1), np.uint8)

    def observation(self, observation):
        return np.full((36, 36, 1), np.clip(128 + 100 * observation[0], 0, 255), np.uint8)


def line(algorithm, **kwargs):
    return Line(**kwargs, n_actions=3 if algorithm in DISCRETE else None)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", EVERY)
@pytest.mark.parametrize("what", ["two environments", "VecNormalize", "n-step", "dict", "her", "images"])
def test_documented_feature_can_be_used(algorithm, what):
    def make():
        return line(algorithm, kind={"dict": "dict", "her": "goal"}.get(what, "array"))

    settings = {}
    if what == "n-step":
        settings["n_steps"] = 3
    if what in ("dict", "her"):
        settings["policy"] = "MultiInputPolicy"
    if what == "her":
        settings["replay_buffer_class"] = HerReplayBuffer
        settings["learning_starts"] = 20
    env = make()
    if what == "two environments":
        env = DummyVecEnv([make, make])
    if what == "VecNormalize":
        env = VecNormalize(DummyVecEnv([make]))
    if what == "images":
        env, settings["policy"] = Picture(make()), "CnnPolicy"
    if algorithm is CrossQAP and what in ("dict", "her", "images"):
        with pytest.raises(ValueError, match="unknown"):
            build(algorithm, env, **settings)  # sb3-contrib's CrossQ has an MlpPolicy alone
    else:
        model = build(algorithm, env, **settings).learn(40)
        assert model.num_timesteps >= 40
        assert not hasattr(model, "predictor") or model.predictor.fitted


def test_pictures_reach_the_policy_channels_first():
    assert build(DDPGAP, Picture(Line()), policy="CnnPolicy").observation_space.shape == (1, 36, 36)
