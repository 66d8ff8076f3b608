"""Measures which settings fit the AP predictor best: the paper's, this package's defaults, and their neighbours.

DDPG-AP is trained on sap/LaneKeeping-v0 (Wheel-2) with the constructor's defaults of everything else. The balanced
validation accuracy of E between steps 500 and 2,000 and the processor time per step are compared. The seeds are those
for tuning, from 100 on.

python measurements/predictor_defaults.py [--seeds 3] [--out results/predictor_defaults.csv]
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap import DDPGAP
from sb3_sap.benchmark.reports.pages import markdown
from sb3_sap.common.files import atomic_path

STEPS, FROM = 2_000, 500
FIRST_SEED = 100
SGD = {"optimizer_class": "SGD", "learning_rate": 0.01}
SETTINGS: dict[str, tuple[int, dict[str, Any]]] = {
    "paper: SGD 0.01, λ 0.01, N_E 2000": (
        2000,
        {"optimizer_class": "SGD", "learning_rate": 0.01, "weight_decay": 0.01},
    ),
    "SGD 0.01, λ 0, N_E 2000": (2000, SGD | {"weight_decay": 0.0}),
    "SGD 0.01, λ 0.01, N_E 512": (512, SGD | {"weight_decay": 0.01}),
    "default: Adam 0.001, λ 0.0001, N_E 512": (512, {}),
    "Adam 0.001, λ 0, N_E 512": (512, {"weight_decay": 0.0}),
    "Adam 0.001, λ 0.01, N_E 512": (512, {"weight_decay": 0.01}),
    "Adam 0.001, λ 0.0001, N_E 2000": (2000, {}),
    "Adam 0.001, λ 0.0001, N_E 128": (128, {}),
}


class Accuracy(BaseCallback):
    """Collects E's validation accuracy."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[float] = []

    def _on_step(self) -> bool:
        self.values.append(self.model.validation_accuracy)  # type: ignore[attr-defined]
        return True


def main(seeds: int, out: Path) -> None:
    """Trains with every setting and seed, writes each row as it ends, and prints the means."""
    th.set_num_threads(1)
    rows = []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        for name, (dataset_size, predictor_kwargs) in SETTINGS.items():
            env = gym.make("sap/LaneKeeping-v0", laps=None)
            accuracy = Accuracy()
            begin = time.process_time()
            model = DDPGAP("MlpPolicy", env, seed=seed, dataset_size=dataset_size, predictor_kwargs=predictor_kwargs)
            model.learn(STEPS, callback=accuracy)
            seconds = time.process_time() - begin
            late = np.array(accuracy.values[FROM:])
            rows.append(
                {
                    "setting": name,
                    "seed": seed,
                    "accuracy": np.nanmean(late),
                    "share_above_70": np.mean(late >= 0.7),
                    "ms_per_step": 1000 * seconds / STEPS,
                }
            )
            with atomic_path(out) as temporary:
                pd.DataFrame(rows).round(4).to_csv(temporary, index=False)
            print(rows[-1], flush=True)
    means = pd.DataFrame(rows).groupby("setting", sort=False).mean().drop(columns="seed").round(3)
    with atomic_path(out.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(means.reset_index()), encoding="utf-8")
    print(means)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results/predictor_defaults.csv"))
    options = parser.parse_args()
    main(options.seeds, options.out)
