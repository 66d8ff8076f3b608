"""Tries the presets of the penalty and the loss on MountainCarContinuous, with SB3's default settings of each base.

Each entry is the mean return of five episodes after 1,000 and 2,000 steps.

python measurements/mountain_car_presets.py   # writes results/screening/mountain_car_presets.csv
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_sap import SACAP, TD3AP, TQCAP, CrossQAP, RescaleExtractor, preset
from sb3_sap.benchmark.reports.pages import write_csv

SEEDS, STEPS = (100, 101, 102), 1_000


def energy_did_not_fall(obs: Any, actions: Any, next_obs: Any) -> Any:
    """The label of the README's second example."""

    def energy(o: Any) -> Any:
        return 0.5 * o[:, 1] ** 2 + 0.0025 / 3 * np.sin(3 * o[:, 0])

    return energy(next_obs) >= energy(obs)


def main() -> None:
    th.set_num_threads(1)
    rows = []
    for algorithm in (SACAP, TD3AP, TQCAP, CrossQAP):
        for name in ("penalty", "loss"):
            for seed in SEEDS:
                model = algorithm(
                    "MlpPolicy",
                    gym.make("MountainCarContinuous-v0"),
                    ap_function=energy_did_not_fall,
                    policy_kwargs={"features_extractor_class": RescaleExtractor},
                    seed=seed,
                    device="cpu",
                    **preset(name, algorithm),
                )
                row: dict[str, Any] = {"algorithm": algorithm.__name__, "preset": name, "seed": seed}
                for after in (STEPS, 2 * STEPS):
                    model.learn(STEPS, reset_num_timesteps=False)
                    test = Monitor(gym.make("MountainCarContinuous-v0"))
                    test.reset(seed=1)
                    row[f"after {after:,}"] = round(float(evaluate_policy(model, test, 5)[0]), 1)  # type: ignore[arg-type]
                rows.append(row)
                print(row, flush=True)
    write_csv(Path("results/screening/mountain_car_presets.csv"), pd.DataFrame(rows))


if __name__ == "__main__":
    main()
