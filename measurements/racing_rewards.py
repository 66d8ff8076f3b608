"""Other rewards of racing, for SAC alone: what one would try before labelling anything.

    python measurements/racing_rewards.py progress crash gauge --seeds 100 --steps 15000

- progress: the environment's own, metres along the centre line.
- crash: the same, and -20 for the step with which the car leaves the road, turns round or has stood.
- gauge: v (cos θ - |sin θ| - |d|) of each step, with θ the angle to the road and d the distance from the centre line in
  half widths, the reward by which TORCS is often learned; and -20 likewise.

A row for every lap from the grid: the part of the track that was driven, and the time of a lap.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_sap.evaluation import make_env
from sb3_sap.evaluation.racing import RACING, race
from sb3_sap.presets import load_config
from sb3_sap.tasks.racing import ANGLE, SPEED_X, TRACK_POS

TRACKS = "wheel-2", "eroad", "g-track-3", "ole-road-1"
#: Reward of an end before the lap is done; a step at 200 km/h earns 5.6.
LOST = -20.0
SHARED = "learning_rate", "gamma", "policy_kwargs"


class Reward(gym.Wrapper[Any, Any, Any, Any]):
    """Another reward of each step.

    :param kind: "progress", "crash" or "gauge"
    """

    def __init__(self, env: gym.Env[Any, Any], kind: str):
        super().__init__(env)
        self.kind = kind

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self.kind == "gauge":
            angle, track_pos, speed = obs[ANGLE], obs[TRACK_POS], obs[SPEED_X] * 100 / 3.6
            along = math.cos(angle) - abs(math.sin(angle)) - abs(track_pos)
            reward = speed * along * 0.1  # s, a control step
        if self.kind != "progress" and terminated:
            reward = LOST
        return obs, float(reward), terminated, truncated, info


def main() -> None:
    """Prints the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rewards", nargs="+", choices=["progress", "crash", "gauge"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[100])
    parser.add_argument("--steps", type=int, default=15_000)
    parser.add_argument("--every", type=int, default=1_500, help="steps between evaluations")
    options = parser.parse_args()
    th.set_num_threads(1)
    entry = load_config("sac_ap")[RACING]
    print("reward | seed | steps | track | covered | lap time", flush=True)
    for kind in options.rewards:
        for seed in options.seeds:
            env = Monitor(Reward(make_env(RACING, **entry["env_kwargs"]), kind))
            model = SAC("MlpPolicy", env, seed=seed, device="cpu", **{name: entry[name] for name in SHARED})
            while model.num_timesteps < options.steps:
                model.learn(options.every, reset_num_timesteps=False)
                for track in TRACKS:
                    lap = race(model, track)
                    time = "" if lap.lap_time is None else f"{lap.lap_time:.1f}"
                    row = kind, seed, model.num_timesteps, track, f"{lap.covered:.3f}", time
                    print(" | ".join(map(str, row)), flush=True)


if __name__ == "__main__":
    main()
