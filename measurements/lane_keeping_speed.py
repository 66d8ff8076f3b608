"""Measures control steps per second of sap/LaneKeeping-v0 through the whole Gymnasium stack, on one core.

python measurements/lane_keeping_speed.py [TRACK] [STEPS]
"""

import sys
import time

import gymnasium as gym
import numpy as np

from sb3_sap.envs.car import STEERING_LOCK


def main(track: str = "wheel-2", steps: int = 20_000) -> None:
    """Drives with linear feedback, which remains on the road, and prints the rate."""
    env = gym.make("sap/LaneKeeping-v0", track=track, laps=None)
    obs, _ = env.reset(seed=0)
    gains = np.array([2.5 / STEERING_LOCK, -1.6, 0.0, 1.0, 0.0], dtype=np.float32)
    begin, began = time.process_time(), time.perf_counter()
    for _ in range(steps):
        obs, _, terminated, truncated, _ = env.step(np.clip(gains @ obs, -1, 1).reshape(1))
        if terminated or truncated:
            obs, _ = env.reset()
    cpu, wall = steps / (time.process_time() - begin), steps / (time.perf_counter() - began)
    print(f"sap/LaneKeeping-v0 on {track}: {cpu:,.0f} control steps/s of processor time, {wall:,.0f} of wall-clock")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "wheel-2", int(sys.argv[2]) if len(sys.argv) > 2 else 20_000)
