"""Measures how the AP functions of Pendulum label random actions and those of a good policy.

The policy is `sac:task`, the base without guidance, whose training no label influences. It is trained, and
`check_permissibility` examines each AP function with it.

python measurements/pendulum_labels.py [--seeds 3] [--out results/Pendulum-v1/labels.csv]
"""

import argparse
from pathlib import Path

import pandas as pd
import torch as th

from sb3_sap import check_permissibility
from sb3_sap.benchmark.configurations import parse_configuration
from sb3_sap.benchmark.learners import make_model
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text
from sb3_sap.benchmark.runs import make_run
from sb3_sap.benchmark.task_settings import planned_steps
from sb3_sap.evaluation.environments import make_env

TASK = "Pendulum-v1"
NAMES = ("pendulum_height", "pendulum_torque", "pendulum_energy")


def main(seeds: int, out: Path) -> None:
    """Trains and examines, seed by seed, and writes the rows and a table of their means."""
    th.set_num_threads(1)
    rows = []
    for seed in range(seeds):
        run = make_run(parse_configuration("sac:task"), TASK, planned_steps(TASK), seed)
        model = make_model(run.algo, make_env(TASK, **run.training), run.settings, seed)
        model.learn(run.steps)
        for name in NAMES:
            report = check_permissibility(
                make_env(TASK), f"sb3_sap.tasks.{name}", policy=model, seed=seed, verbose=False
            )
            found = {
                "AP function": name,
                "seed": seed,
                "refused of random actions": 1 - report.permissible_rate,
                "refused of SAC's actions": report.policy_forbidden,
                "states where the action decides": report.action_matters,
                "accuracy of a classifier": report.accuracy,
            }
            rows.append(found | {"advice": " ".join(report.advice)})
            print(rows[-1], flush=True)
            write_csv(out, pd.DataFrame(rows).round(4))
    means = pd.DataFrame(rows).drop(columns=["seed", "advice"]).groupby("AP function", sort=False).mean()
    write_text(out.with_suffix(".md"), markdown(means.round(3).reset_index()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results/Pendulum-v1/labels.csv"))
    arguments = parser.parse_args()
    main(arguments.seeds, arguments.out)
