"""Control steps per second of sap/LaneKeeping-v0 through the whole Gymnasium stack, on one core.

python benchmarks/bench_lane_keeping.py [TRACK] [STEPS]
"""

import sys
import time

import gymnasium as gym
import numpy as np

import sb3_sap  # noqa: F401  # registers the environment


def main(track: str = "wheel-2", steps: int = 20_000) -> None:
    """Drive with linear feedback, which stays on the road, and print the rate."""
    env = gym.make("sap/LaneKeeping-v0", track=track, laps=None)
    obs, _ = env.reset(seed=0)
    gains = np.array([2.5 / 0.366519, -1.6, 1.0, 0.0, 0.0], dtype=np.float32)
    gains[2], gains[3] = 0.0, 1.0  # speedX plays no part
    begin = time.process_time()
    for _ in range(steps):
        obs, _, terminated, truncated, _ = env.step(np.clip(gains @ obs, -1, 1).reshape(1))
        if terminated or truncated:
            obs, _ = env.reset()
    seconds = time.process_time() - begin
    print(f"{env.spec.id if env.spec else env} on {track}: {steps / seconds:,.0f} control steps/s of processor time")


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
