"""A quick look at a task: returns while training, without evaluations, of the base, a penalty, the loss and guidance.

    python measurements/training_returns.py dqn_ap sap/MiniGrid-v0 --seeds 100 101 --steps 6000

A row for each way and seed: the mean return of the episodes of each quarter of the steps, the number of episodes, the
share of mistakes, and the accuracy of E at the end.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.monitor import Monitor

from sb3_sap.algorithms import GUIDED_ALGORITHMS
from sb3_sap.benchmark.task_settings import GUIDANCE
from sb3_sap.evaluation import make_env
from sb3_sap.presets import load_config, preset, preset_names, settings_in


def run(algo: str, env_id: str, way: str, seed: int, steps: int) -> str:
    """Trains one model and describes it in a row."""
    entry = load_config(algo)[env_id]
    settings = settings_in(entry)
    if way != "guidance":
        settings = {name: value for name, value in settings.items() if name not in GUIDANCE}
        settings |= preset("loss" if way == "loss" else "penalty", algo) | ({"penalty": 0.0} if way == "base" else {})
    env = Monitor(make_env(env_id, **entry.get("env_kwargs", {})))
    model: Any = GUIDED_ALGORITHMS[algo](entry["policy"], env, seed=seed, **settings).learn(steps)
    quarters = np.array_split(np.arange(steps), 4)
    ends = np.cumsum(env.get_episode_lengths())
    returns = np.array(env.get_episode_rewards())
    means = [returns[(ends > quarter[0]) & (ends <= quarter[-1] + 1)].mean() for quarter in quarters]
    mistakes, others = model.knowledge.seen
    share = mistakes / (mistakes + others)
    numbers = " ".join(f"{mean:.2f}" for mean in means)
    return f"{way} | {seed} | {numbers} | {len(returns)} | {share:.1%} | {model.validation_accuracy:.3f}"


def main() -> None:
    """Prints the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algo", choices=list(GUIDED_ALGORITHMS))
    parser.add_argument("env", help="environment with an entry in zoo_configs")
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101])
    parser.add_argument("--steps", type=int, required=True)
    options = parser.parse_args()
    th.set_num_threads(1)
    loss = ["loss"] if "loss" in preset_names(options.algo) else []
    print("way | seed | mean return in each quarter | episodes | mistakes | accuracy of E", flush=True)
    for seed in options.seeds:
        for way in ("base", "penalty", *loss, "guidance"):
            print(run(options.algo, options.env, way, seed, options.steps), flush=True)


if __name__ == "__main__":
    main()
