"""Tunes every way of using the label with the same budget: as many draws from the same grid, and a knob of its own.

    python measurements/equal_budget.py ddpg_ap torcs --steps 500 --out results/tuning/equal_budget_ddpg.csv

The columns are the base algorithm, shaping by a potential, the penalty, the loss and guidance. Each draws `--draws`
configurations of learning rate, γ and exploration (on-policy of the length of a rollout), with a value of its own knob;
the first of them is its preset. They train with seed 100, and the best `--again` once more with seeds 101 and 102,
which decide. A run's value is the mean score over all its evaluations, on tracks that are not among the test tracks, so
that learning sooner and ending better both count. The last line has the winners, as `sb3-sap benchmark ways
--configurations` reads them.
"""

from __future__ import annotations

import argparse
import random
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console

from sb3_sap.benchmark.configurations import parse_configuration
from sb3_sap.benchmark.dispatch import run_grid
from sb3_sap.benchmark.reports.pages import write_csv
from sb3_sap.benchmark.runs import make_run
from sb3_sap.benchmark.store import read_result
from sb3_sap.benchmark.task_settings import EPISODES
from sb3_sap.evaluation.laps import ENVIRONMENTS

#: Tracks that are not among the test tracks.
TRACKS = {"torcs": ("g-track-1", "aalborg", "e-track-1"), "highway": ("random:100", "random:101", "random:102")}
#: The grid that all columns share, by algorithm; the learning rate of PPO may fall to 0, as is usual.
DISCOUNTS = {"gamma": ["0.9", "0.95", "0.99"]}
RATES = {"learning_rate": ["0.0003", "0.001", "0.002"]}
NOISE = {"action_noise": ["null", '{"type":"normal","sigma":0.1}', '{"type":"normal","sigma":0.3}']}
ENTROPY = {"ent_coef": ["auto", "auto_0.1"]}
ROLLOUTS = {"learning_rate": ["0.0003", "0.001", "lin_0.001", "lin_0.002"], "n_steps": ["128", "256", "512"]}
# SB3's first deviation of 1 is wide for actions from -1 to 1.
DEVIATIONS = {"policy_kwargs.log_std_init": ["0", "-1"]}
SHARED: dict[str, dict[str, list[str]]] = {
    "ddpg_ap": RATES | DISCOUNTS | NOISE,
    "td3_ap": RATES | DISCOUNTS | NOISE,
    "sac_ap": RATES | DISCOUNTS | ENTROPY,
    "tqc_ap": RATES | DISCOUNTS | ENTROPY,
    "ppo_ap": ROLLOUTS | DISCOUNTS | DEVIATIONS,
}
#: The potentials of each task, of which the second is tried first.
POTENTIALS = {
    **{simulator: [f"sb3_sap.benchmark.potentials.centre_{size}" for size in (30, 100, 300)] for simulator in TRACKS},
    "MountainCarContinuous-v0": [f"sb3_sap.benchmark.potentials.energy_{size}" for size in (1, 10, 100)],
}


class Column(NamedTuple):
    """A way of using the label: its preset, what the first draw and what all draws change in it, and its own knobs."""

    preset: str
    first: str
    always: str
    knobs: dict[str, list[str]]


def columns(algo: str, simulator: str) -> dict[str, Column]:
    """The ways that are compared, by name."""
    potentials = POTENTIALS[simulator]
    if algo == "ppo_ap":
        penalty = {"penalty": ["auto_0.1", "auto_0.25", "auto"]}
        loss = {"permissibility_coef": ["lin_1.0", "lin_3.0", "lin_10.0"]}
        guidance = Column("base+loss", "alpha=1", "alpha=1,", {"permissibility_coef": ["0", "lin_1.0", "lin_3.0"]})
    else:
        penalty = {"penalty": ["auto_0.3", "auto", "auto_3"]}
        loss = {"permissibility_coef": ["lin_0.3_0.5", "lin_1.0_0.5", "lin_3.0_0.5"]}
        knobs = {"actor_permissibility_coef": ["1", "3"], "alpha": ["0.5", "0.9"]}
        guidance = Column("fast" if simulator in ENVIRONMENTS else "task", "", "", knobs)
    return {
        "base": Column("base+penalty", "penalty=0", "penalty=0,", {}),
        "shaping": Column(
            "base+penalty", f"penalty=0,potential={potentials[1]}", "penalty=0,", {"potential": potentials}
        ),
        "penalty": Column("base+penalty", "", "", penalty),
        "loss": Column("base+loss", "", "", loss),
        "guidance": guidance,
    }


def draws(algo: str, column: Column, number: int) -> list[str]:
    """Names of configurations, the preset first; equal ones are drawn once."""
    same, own = random.Random(100), random.Random(200)  # all columns draw the same of what they share
    text = f"[{column.first}]" if column.first else ""
    names: list[str] = []
    while len(names) < number:
        names += [name for name in [parse_configuration(f"{algo}:{column.preset}{text}").name] if name not in names]
        chosen = {key: same.choice(values) for key, values in SHARED[algo].items()}
        chosen |= {key: own.choice(values) for key, values in column.knobs.items()}
        text = f"[{column.always}{','.join(f'{key}={value}' for key, value in chosen.items())}]"
    return names


def values(names: list[str], seeds: list[int], options: argparse.Namespace) -> dict[str, float]:
    """The mean score of each configuration over seeds, evaluations and tracks."""
    lane_keeping = options.simulator in ENVIRONMENTS
    tracks = TRACKS[options.simulator] if lane_keeping else EPISODES
    parsed = [parse_configuration(name) for name in names]
    grid = {each: [make_run(each, options.simulator, options.steps, s, tracks) for s in seeds] for each in parsed}
    run_grid(grid, options.runs, Console(), options.jobs)
    found = {}
    for each, runs in grid.items():
        laps = [result["laps"] for run in runs if (result := read_result(run, options.runs)) is not None]
        scores = [pd.DataFrame(table["data"], columns=table["columns"])["score"].mean() for table in laps]
        found[each.name] = float(np.mean(scores)) if len(scores) == len(seeds) else float("nan")
    return found


def main() -> None:
    """Writes a row for each draw and prints the winners."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algo", choices=SHARED, help="a guided algorithm with continuous actions")
    parser.add_argument("simulator", help=f"one of {', '.join(ENVIRONMENTS)}, or the id of a task")
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--columns", nargs="+", help="ways to tune, such as penalty and loss; by default all")
    parser.add_argument("--again", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where single runs are kept")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    drawn = {
        name: draws(options.algo, column, options.draws)
        for name, column in columns(options.algo, options.simulator).items()
        if not options.columns or name in options.columns
    }
    first = values([name for names in drawn.values() for name in names], [100], options)
    best = {column: sorted(names, key=lambda name: -first[name])[: options.again] for column, names in drawn.items()}
    again = values([name for names in best.values() for name in names], [101, 102], options)
    rows = [
        {"column": column, "configuration": name, "seed 100": first[name], "seeds 101 and 102": again.get(name)}
        for column, names in drawn.items()
        for name in names
    ]
    write_csv(options.out, pd.DataFrame(rows).round(4))
    print(" ".join(f"'{max(names, key=lambda name: again[name])}'" for names in best.values()))


if __name__ == "__main__":
    main()
