"""MiniGrid with labels: which actions have an effect, and what is observed."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sb3_sap  # noqa: F401  # registers the environment

key = pytest.importorskip("minigrid.core.world_object").Key
LEFT, RIGHT, FORWARD, PICK_UP, DROP, TOGGLE, DONE = range(7)


def labels(env, *actions):
    return [env.step(action)[4]["permissible"] for action in actions]


def test_actions_without_effect_are_mistakes():
    env = gym.make("sap/MiniGrid-v0", task="Empty-5x5")
    env.reset(seed=0)  # in the corner (1, 1), facing right
    assert labels(env, LEFT, FORWARD, RIGHT, RIGHT) == [True, False, True, True]  # a wall is above
    assert labels(env, PICK_UP, DROP, TOGGLE, DONE) == [False] * 4


def test_key_and_door_have_effects_once():
    env = gym.make("sap/MiniGrid-v0", task="DoorKey-5x5")
    env.reset(seed=0)
    grid = env.unwrapped
    ahead = tuple(map(int, grid.front_pos))
    grid.grid.set(*ahead, key("yellow"))
    env.step(LEFT)
    env.step(RIGHT)  # the wrapper has seen the key now
    assert labels(env, FORWARD, PICK_UP, PICK_UP, DROP, DROP) == [False, True, False, True, False]


def test_step_that_ends_the_episode_is_not_judged():
    env = gym.make("sap/MiniGrid-v0", task="Empty-5x5")
    env.reset(seed=0)
    for action in (FORWARD, FORWARD, RIGHT, FORWARD):
        env.step(action)
    _, reward, terminated, _, info = env.step(FORWARD)
    assert terminated
    assert reward > 0
    assert info["permissible"] is True
    assert info["is_success"] is True


def test_observation_is_the_view_and_the_direction_one_hot():
    env = gym.make("sap/MiniGrid-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that wrappers are around it
        check_env(env, skip_render_check=True)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (7 * 7 * 20 + 4,)
    assert obs.dtype == np.uint8
    assert obs[-4:].sum() == 1
    turned = env.step(RIGHT)[0]
    assert turned[-4:].argmax() == (obs[-4:].argmax() + 1) % 4
