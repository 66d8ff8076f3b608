"""Learns to drive an underpowered car up a hill, from a label of your own."""

import gymnasium as gym
import numpy as np

from sb3_sap import SACAP, RescaleExtractor, check_permissibility


def energy_did_not_fall(obs, actions, next_obs):  # (n, 2), (n, 1), (n, 2) -> (n,) bool
    before, after = (0.5 * o[:, 1] ** 2 + 0.0025 / 3 * np.sin(3 * o[:, 0]) for o in (obs, next_obs))
    return after >= before


env = gym.make("MountainCarContinuous-v0")
check_permissibility(env, energy_did_not_fall)  # is there anything to learn from this label?
model = SACAP(
    "MlpPolicy",
    env,
    ap_function=energy_did_not_fall,
    actor_permissibility_coef=1.0,  # adds an auxiliary loss to the actor
    policy_kwargs={"features_extractor_class": RescaleExtractor},  # positions are ones, velocities hundredths
    seed=1,
)
model.learn(1_000)
