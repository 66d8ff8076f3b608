"""Measures what E predicts at the standing start, where DDPG-AP with the paper's settings may spin.

DDPG-AP is trained for 500 steps with the paper's settings on TORCS' Wheel-2, with E fitted as in the paper and with E
fitted as by default. Then the actor steers the first two seconds of a lap from standstill. Two things are measured: the
*spread* of E's probability over five steering angles, which is how much the action matters to E, and the share of the
actor's mistakes that E would permit (*passed*). The seeds are 0 to 9, those of the runs that this explains.

python measurements/standing_start.py [--seeds 10] [--out results/standing_start.csv]
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th

from sb3_sap.benchmark.configurations import parse_configuration
from sb3_sap.benchmark.learners import make_model
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text
from sb3_sap.benchmark.runs import make_run
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS, lap, lap_env
from sb3_sap.evaluation.predictor_plots import permissible_probability

STEPS, TRACK = 500, "g-track-1"
LOOK = 10  # control steps of 0.2 s, two seconds
STEERING = np.linspace(-1, 1, 5, dtype=np.float32)[:, None]
CONFIGURATIONS = {
    "E as in the paper": "ddpg_ap:paper",
    "E with Adam 0.001, λ 0.0001": "ddpg_ap:paper[predictor_kwargs.optimizer_class=Adam,"
    "predictor_kwargs.learning_rate=0.001,predictor_kwargs.weight_decay=0.0001]",
}


def measure(configuration: str, seed: int) -> dict[str, float]:
    """Trains one model and measures E and the actor at the standing start."""
    run = make_run(parse_configuration(configuration), "torcs", 3_000, seed)  # t_k is that of a run of 3,000 steps
    model: Any = make_model(run.algo, make_env(ENVIRONMENTS["torcs"], **run.training), run.settings, seed)
    model.learn(STEPS)
    env = lap_env(TRACK, "torcs")
    obs, _ = env.reset(seed=0)
    spreads, missed, mistakes = [], [], 0
    for _ in range(LOOK):
        action, _ = model.predict(obs, deterministic=True)
        steering = np.concatenate([STEERING, action[None]])
        probability = permissible_probability(model, obs[None], steering)[0]
        obs, _, terminated, truncated, info = env.step(action)
        spreads.append(np.ptp(probability[:-1]))
        mistakes += not info["permissible"]
        missed.append(not info["permissible"] and probability[-1] > 0.5)
        if terminated or truncated:
            break
    return {
        "accuracy": model.validation_accuracy,
        "spread": float(np.mean(spreads)),
        "mistakes": mistakes / len(spreads),
        "passed": sum(missed) / max(1, mistakes),
        "score": lap(model, env, TRACK).score,
    }


def main(seeds: int, out: Path) -> None:
    """Measures every configuration and seed, and writes each row as it ends, then the table."""
    th.set_num_threads(1)
    rows = []
    for seed in range(seeds):
        for name, configuration in CONFIGURATIONS.items():
            rows.append({"predictor": name, "seed": seed} | measure(configuration, seed))
            print(rows[-1], flush=True)
            write_csv(out, pd.DataFrame(rows).round(4))
    table = pd.DataFrame(rows).assign(failed=lambda rows: rows["score"] < 0.1)
    means = table.groupby(["predictor", "failed"], sort=False).mean(numeric_only=True).round(3)
    counts = table.groupby(["predictor", "failed"], sort=False).size().rename("runs")
    write_text(out.with_suffix(".md"), markdown(means.drop(columns="seed").join(counts).reset_index()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("results/standing_start.csv"))
    options = parser.parse_args()
    main(options.seeds, options.out)
