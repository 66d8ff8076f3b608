"""Learns to drive an underpowered car up a hill, from a label of your own."""

import gymnasium as gym
import numpy as np

from sb3_sap import SACAP, RescaleExtractor, check_permissibility, preset


def energy_did_not_fall(obs, actions, next_obs):  # (n, 2), (n, 1), (n, 2) -> (n,) bool
    def energy(o):
        return 0.5 * o[:, 1] ** 2 + 0.0025 / 3 * np.sin(3 * o[:, 0])

    return energy(next_obs) >= energy(obs)


env = gym.make("MountainCarContinuous-v0")
check_permissibility(env, energy_did_not_fall)  # is there anything to learn from it?
model = SACAP(
    "MlpPolicy",
    env,
    ap_function=energy_did_not_fall,
    # scales the observations: positions are ones, velocities hundredths
    policy_kwargs={"features_extractor_class": RescaleExtractor},
    seed=1,
    **preset("penalty", SACAP),  # without it, actions that the predictor rejects are replaced
)
model.learn(1_000)
