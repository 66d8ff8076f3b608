"""Counts the forbidden actions that each algorithm with finite actions executes under a known mask: none is the aim.

Taxi, whose `action_masks()` forbids driving into walls and more, in eight environments of processes of their own. What
was executed is compared with the mask of the state before the step, outside of the package.

python measurements/illegal_actions.py --out results/illegal_actions.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_sap import A2CAP, DQNAP, PPOAP, QRDQNAP, TRPOAP, ActionMaskObservation, RecurrentPPOAP
from sb3_sap.benchmark.reports.pages import write_csv

ENVIRONMENTS, SEED = 8, 100
ALGORITHMS: tuple[Any, ...] = (DQNAP, QRDQNAP, PPOAP, A2CAP, TRPOAP, RecurrentPPOAP)


class Count(BaseCallback):
    """Counts actions that the mask of their state forbids, and all that it could have forbidden."""

    def __init__(self) -> None:
        super().__init__()
        self.executed = self.forbidden = self.choices = 0

    def _on_step(self) -> bool:
        masks = self.model._last_obs["action_mask"] > 0.5  # type: ignore[index, call-overload]
        actions = np.asarray(self.locals["actions"]).reshape(-1)
        self.executed += len(actions)
        self.forbidden += int((~masks[np.arange(len(actions)), actions]).sum())
        self.choices += int((~masks).any(axis=1).sum())
        return True


def main() -> None:
    """Writes a row for each algorithm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    th.set_num_threads(1)
    rows = []
    for algorithm in ALGORITHMS:
        env = make_vec_env(
            "sap/Taxi-v0", ENVIRONMENTS, SEED, wrapper_class=ActionMaskObservation, vec_env_cls=SubprocVecEnv
        )
        policy = "MultiInputLstmPolicy" if algorithm is RecurrentPPOAP else "MultiInputPolicy"
        model = algorithm(policy, env, permissible_actions="action_mask", seed=SEED, device="cpu")
        count = Count()
        model.learn(options.steps, callback=count)
        env.close()
        rows.append(
            {
                "algorithm": algorithm.__name__,
                "steps": count.executed,
                "with a forbidden action": count.choices,
                "forbidden executed": count.forbidden,
            }
        )
        print(rows[-1], flush=True)
        write_csv(options.out, pd.DataFrame(rows))


if __name__ == "__main__":
    main()
