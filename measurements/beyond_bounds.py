"""How far the mean of PPO goes beyond the bounds of the action in a long training, and what that does to driving.

SB3 clips the actions of PPO to their bounds. A policy whose first standard deviation is as wide as the bounds is then
noisy wherever its mean lies within them, and less so beyond: the mean moves outwards, and the policy without noise
steers from one side to the other.

python measurements/beyond_bounds.py --out results/screening/beyond_bounds.csv

Writes a row for each way, first deviation and 2,048 steps, of the policy without noise on tracks that are not among
the test tracks: S, the size of its mean steering, and the share of steps in which it lies beyond the bounds.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap.benchmark.configurations import parse_configuration
from sb3_sap.benchmark.learners import make_model, settings_of
from sb3_sap.benchmark.reports.pages import write_csv
from sb3_sap.evaluation.laps import ENVIRONMENTS, lap, lap_env

TRACKS = ("g-track-1", "aalborg", "e-track-1")
WAYS = {"PPO alone": "ppo_ap:base+penalty[penalty=0,{}]", "loss": "ppo_ap:base+loss[{}]"}
STEPS, EVERY, SEED = 20_480, 2_048, 100


class Mean:
    """Acts by the mean of a policy, and keeps it."""

    def __init__(self, policy: Any):
        self.policy = policy
        self.found: list[float] = []

    @th.no_grad()
    def predict(self, observation: np.ndarray, deterministic: bool = True) -> tuple[np.ndarray, None]:
        mean = self.policy.get_distribution(th.as_tensor(observation[None])).distribution.mean.numpy()[0]
        self.found.append(float(mean[0]))
        return np.clip(mean, -1, 1), None


class Laps(BaseCallback):
    """Drives the tracks after every `EVERY` steps."""

    def __init__(self, row: dict[str, Any], rows: list[dict[str, Any]]):
        super().__init__()
        self.row, self.rows = row, rows
        self.envs = {track: lap_env(track, "torcs") for track in TRACKS}

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps % EVERY == 0:
            acting = Mean(self.model.policy)
            score = np.mean([lap(acting, env, track).score for track, env in self.envs.items()])
            size = np.abs(acting.found)
            found = {"S": score, "mean, size": size.mean(), "beyond the bounds": (size > 1).mean()}
            self.rows.append(self.row | {"steps": self.num_timesteps} | found)
            print(self.rows[-1], flush=True)


def main() -> None:
    """Trains and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    th.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for way, name in WAYS.items():
        for log_std in (0, -1):
            configuration = parse_configuration(name.format(f"policy_kwargs.log_std_init={log_std}"))
            env = gym.make(ENVIRONMENTS["torcs"], track="wheel-2", laps=None)
            model = make_model("ppo_ap", env, settings_of(configuration, "torcs", STEPS), SEED)
            model.learn(STEPS, callback=Laps({"way": way, "log_std_init": log_std}, rows))
            write_csv(out, pd.DataFrame(rows).round(3))


if __name__ == "__main__":
    main()
