"""Mistakes that show later: how well E predicts them, and whether a learned risk is better than a fixed horizon.

    python measurements/late_mistakes.py cart-pole --seeds 100 101 102 --steps 6000
    python measurements/late_mistakes.py highway --seeds 100 --steps 4000

A row for each way of labelling and seed, of training alone: the mean return of the episodes and how many there were,
the share of steps labelled as mistakes, and the balanced accuracy of E, the mean over the last quarter of the training.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from sb3_sap import DQNAP, SACAP
from sb3_sap.evaluation import make_env
from sb3_sap.presets import load_config, settings_in

FALL = {"event": "terminated"}
#: Twelve steps are what a discount of 0.9 and a threshold of 0.3 stand for.
CART_POLE: dict[str, dict[str, Any]] = {
    "no guidance": {**FALL, "horizon": 12, "alpha": 0.0},
    "horizon 12": {**FALL, "horizon": 12},
    "risk 0.9": {**FALL, "risk_discount": 0.9, "risk_threshold": 0.3},
    "horizon 12, penalty, guided": {**FALL, "horizon": 12, "penalty": 1.0},
    "risk 0.9, penalty, guided": {**FALL, "risk_discount": 0.9, "risk_threshold": 0.3, "penalty": 1.0},
}
HIGHWAY: dict[str, dict[str, Any]] = {
    "AP function": {},
    "horizon 5": {"ap_function": None, **FALL, "horizon": 5},
    "horizon 10": {"ap_function": None, **FALL, "horizon": 10},
}


class Accuracy(BaseCallback):
    """Keeps the accuracy of E after each step."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[float] = []

    def _on_step(self) -> bool:
        model: Any = self.model
        self.found.append(model.validation_accuracy)
        return True


def run(task: str, way: str, seed: int, steps: int) -> str:
    """Trains one model and describes it in a row."""
    model: Any
    if task == "cart-pole":
        env = Monitor(make_env("CartPole-v1"))
        settings: dict[str, Any] = {"learning_rate": 1e-3, "refit_growth": 0.005, "learning_starts": 200}
        settings |= {"policy_kwargs": {"net_arch": [64, 64]}, "target_update_interval": 500}
        model = DQNAP("MlpPolicy", env, seed=seed, **settings | CART_POLE[way])
    else:
        entry = load_config("sac_ap")["highway-fast-v0"]
        env = Monitor(make_env("highway-fast-v0", **entry["env_kwargs"]))
        model = SACAP("MlpPolicy", env, seed=seed, **settings_in(entry) | HIGHWAY[way])
    accuracy = Accuracy()
    model.learn(steps, callback=accuracy)
    returns, (mistakes, others) = env.get_episode_rewards(), model.knowledge.seen
    last = float(np.nanmean(accuracy.found[-steps // 4 :]))
    values = [f"{np.mean(returns):.1f}", str(len(returns)), f"{mistakes / (mistakes + others):.1%}", f"{last:.3f}"]
    return " | ".join([way, str(seed), *values])


def main() -> None:
    """Prints the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=["cart-pole", "highway"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101, 102])
    parser.add_argument("--steps", type=int, default=6_000)
    parser.add_argument("--ways", nargs="+", choices=[*CART_POLE, *HIGHWAY], help="of labelling; by default all")
    options = parser.parse_args()
    th.set_num_threads(1)
    print("labels | seed | mean return | episodes | mistakes | accuracy of E", flush=True)
    for way in options.ways or (CART_POLE if options.task == "cart-pole" else HIGHWAY):
        for seed in options.seeds:
            print(run(options.task, way, seed, options.steps), flush=True)


if __name__ == "__main__":
    main()
