"""Measures control steps per second of sap/TorcsLaneKeeping-v0 through the whole Gymnasium stack, and of its physics.

The rates are per second of processor time of one core.

python measurements/torcs_speed.py [TRACK]
"""

import sys
import time
from typing import Any

import gymnasium as gym
import numpy as np

import sb3_sap  # noqa: F401  # registers the environment
from sb3_sap.envs.torcs.physics import TICK

STEPS = {0.2: 4_000, 0.02: 40_000}
TICKS = 100_000


def main(track: str = "wheel-2") -> None:
    """Drives with linear feedback, which remains on the road, and prints the rates; then the physics alone."""
    gains = np.array([2.5 / 0.366519, -1.6, 0.0, 1.0, 0.0], dtype=np.float32)
    for control_step, steps in STEPS.items():
        env = gym.make("sap/TorcsLaneKeeping-v0", track=track, control_step=control_step, laps=None)
        obs, _ = env.reset(seed=0)
        begin = time.process_time()
        for _ in range(steps):
            obs, _, terminated, truncated, _ = env.step(np.clip(gains @ obs, -1, 1).reshape(1))
            if terminated or truncated:
                obs, _ = env.reset()
        rate = steps / (time.process_time() - begin)
        print(f"control step {control_step} s: {rate:,.0f} steps/s, {rate * control_step:,.0f}× real time")
    unwrapped: Any = env.unwrapped
    simulation = unwrapped.simulator.simulation
    begin = time.process_time()
    simulation.advance(TICKS)
    seconds = time.process_time() - begin
    print(f"the physics alone: {1e6 * seconds / TICKS:.2f} µs per tick, {TICKS * TICK / seconds:,.0f}× real time")


if __name__ == "__main__":
    main(*sys.argv[1:2])
