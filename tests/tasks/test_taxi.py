"""Taxi with a decoded observation: its masks, and its label, say the same before and after a step."""

import gymnasium as gym
import numpy as np

import sb3_sap  # noqa: F401  # registers the environment
from sb3_sap.tasks import taxi


def test_an_action_is_permissible_where_the_mask_allows_it():
    env = gym.make("sap/Taxi-v0")
    rng, seen = np.random.default_rng(0), set()
    obs, _ = env.reset(seed=0)
    for _ in range(2_000):
        mask = env.get_wrapper_attr("action_masks")()
        action = rng.integers(6)
        next_obs, _, terminated, truncated, _ = env.step(action)
        label = taxi(obs[None], np.array([action]), next_obs[None])
        assert label.tolist() == [bool(mask[action])]
        seen.add((int(action), bool(mask[action])))
        obs = env.reset()[0] if terminated or truncated else next_obs
    assert len(seen) >= 11  # nearly every action was both allowed and forbidden


def test_observation_is_the_decoded_state():
    env = gym.make("sap/Taxi-v0")
    obs, _ = env.reset(seed=3)
    assert env.observation_space.contains(obs)
    inner = env.unwrapped
    assert inner.encode(*map(int, obs)) == inner.s
    assert taxi(np.array([5, 7]), np.array([0, 0]), np.array([5, 8])).tolist() == [False, True]
