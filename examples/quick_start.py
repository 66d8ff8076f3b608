"""Learns to keep a car in its lane, then drives a track that it has never seen."""

import gymnasium as gym

from sb3_sap import SACAP, preset
from sb3_sap.evaluation import drive_lap

# The environment labels every step in info["permissible"].
env = gym.make("sap/LaneKeeping-v0", track="wheel-2", laps=None)
model = SACAP("MlpPolicy", env, seed=1, **preset("fast", SACAP))
model.learn(1_000, progress_bar=True)
model.save("wheel2")  # the actor, the critics, the predictor and its optimizer
print(drive_lap(model, "g-track-3"))
