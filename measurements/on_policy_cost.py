"""Measures what permissibility costs per training step of PPO: PPOAP beside PPO with the same settings.

`mask` and `draws` are `alpha=1`, the masks of finite actions and the draws of continuous ones; `loss` is the preset of
that name; `an output each` gives E an output for each action. The two models of a pair train in turn, a
rollout at a time, in one process and thread, so that other work on the machine affects both. The parts are measured
inside the guided model.

Processor time is measured after the first 2,048 steps, whose labels are fitted eight times as often as later ones.
What these steps cost more than PPO's, once in a training however long it is, is in a column of its own.

python measurements/on_policy_cost.py [--cases cartpole actions torcs]   # writes .csv and .md
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from step_cost import seconds, timed

from sb3_sap import PPOAP, preset
from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text
from sb3_sap.onpolicy.draws import DrawingGuide
from sb3_sap.onpolicy.enumerated import EnumeratedGuide
from sb3_sap.onpolicy.labels import LabelCallback
from sb3_sap.onpolicy.loss import PermissibilityLoss
from sb3_sap.predictor.callbacks import PermissibilityCallback

ACTIONS = 1_000
#: Steps in which E is fitted more often than later.
FIRST_STEPS = 2_048
PARTS = ("labels", "fit E", "validate E", "guide", "loss")


class Target(gym.Env[Any, Any]):
    """A point on a line: each action names a place, and the reward is how near it is to the point."""

    observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = spaces.Discrete(ACTIONS)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = 1.0 - abs(float(place(action) - self._obs[0]))
        self._steps += 1
        return self._observe(), reward, False, self._steps == 100, {}

    def _observe(self) -> Any:
        self._obs = self.np_random.uniform(-1, 1, 4).astype(np.float32)
        return self._obs


def place(action: Any) -> Any:
    """Of an action, from -1 to 1."""
    return 2 * np.asarray(action) / (ACTIONS - 1) - 1


def not_far(obs, actions, next_obs):
    return np.abs(place(actions) - obs[:, 0]) < 0.8


def pushes_below_the_pole(obs, actions, next_obs):
    falling = obs[:, 2] + 0.3 * obs[:, 3]
    return (np.abs(falling) < 0.02) | (actions == (falling > 0))


class Case(NamedTuple):
    """What is trained.

    :param bar: highest ratio that is acceptable
    :param labels: constructor arguments of PPOAP alone
    :param steps: measured ones
    """

    make_env: Callable[[], Any]
    settings: dict[str, Any]
    labels: dict[str, Any]
    steps: int
    bar: float


def torcs() -> Any:
    return gym.make("sap/TorcsLaneKeeping-v0", track="wheel-2", laps=None)


CASES = {
    "cartpole": Case(
        lambda: make_vec_env("CartPole-v1", 8), {"n_steps": 256}, {"ap_function": pushes_below_the_pole}, 8_192, 1.6
    ),
    "actions": Case(Target, {"n_steps": 512}, {"ap_function": not_far}, 4_096, 1.5),
    "torcs": Case(torcs, preset("tuned", "ppo"), {}, 3_072, 1.25),
}
WAYS = {
    "cartpole": ("mask", "loss"),
    "actions": ("mask", "loss", "mask, an output each", "loss, an output each"),
    "torcs": ("draws", "loss"),
}
TITLES = {
    "cartpole": "CartPole-v1, 8 environments",
    "actions": f"{ACTIONS:,} actions",
    "torcs": "lane keeping on TORCS",
}


def watch_the_parts() -> None:
    watched: tuple[tuple[Any, str, str], ...] = (
        (LabelCallback, "_on_step", "labels"),
        (PermissibilityCallback, "fit", "fit E"),
        (PermissibilityCallback, "validate", "validate E"),
        (EnumeratedGuide, "distribution", "guide"),
        (DrawingGuide, "first_permissible", "guide"),
        (DrawingGuide, "log_prob", "guide"),
        (PermissibilityLoss, "added_to", "loss"),
    )
    for cls, method, name in watched:
        setattr(cls, method, timed(name, getattr(cls, method)))


def measure(name: str, way: str) -> dict[str, object]:
    """One row: milliseconds per step of both models, and of the parts of the guided one."""
    case = CASES[name]
    own: dict[str, Any] = preset("loss", PPOAP) if way.startswith("loss") else {"alpha": 1}
    if way.endswith("an output each"):
        own["predictor_kwargs"] = {"output_per_action": True}
    arguments: dict[str, Any] = {"policy": "MlpPolicy", "seed": 100, "device": "cpu", **case.settings}
    models: list[Any] = [
        PPO(env=case.make_env(), **arguments),
        PPOAP(env=case.make_env(), **arguments, **case.labels, **own),
    ]
    rollout = models[0].n_steps * models[0].n_envs
    steps = FIRST_STEPS + case.steps
    first, spent = [0.0, 0.0], [0.0, 0.0]
    for model in models:  # a schedule sees the whole training, not the rollout that is being measured
        model._update_current_progress_remaining = lambda done, _, model=model: setattr(
            model, "_current_progress_remaining", 1 - done / steps
        )
    for done in range(0, steps, rollout):
        if done == FIRST_STEPS:
            seconds.clear()
        for number, model in enumerate(models):
            begun = time.process_time()
            model.learn(rollout, reset_num_timesteps=done == 0)
            (spent if done >= FIRST_STEPS else first)[number] += time.process_time() - begun
    alone, with_e = (1000 * each / case.steps for each in spent)
    row: dict[str, object] = {"case": TITLES[name], "way": way, "steps": f"{case.steps:,}"}
    row |= {"PPO, ms": f"{alone:.2f}", "PPOAP, ms": f"{with_e:.2f}", "ratio": f"{with_e / alone:.2f}"}
    row |= {"at most": f"{case.bar:g}"}
    row |= {f"{part}, ms": f"{1000 * seconds[part] / case.steps:.3f}" for part in PARTS}
    row["first steps, s more"] = f"{first[1] - first[0]:.1f}"
    return row | {"E accurate": "yes" if models[1].predictor_accurate else "no"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--out", type=Path, default=Path("results/on_policy_cost.csv"))
    options = parser.parse_args()
    th.set_num_threads(1)
    watch_the_parts()
    made = provenance()
    rows = []
    for name in options.cases:
        for way in WAYS[name]:
            rows.append(measure(name, way))
            print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    write_csv(options.out, table)
    of = f"Processor time of a step, on {made['machine']}, {made['date']}, revision {made['revision']}."
    write_text(options.out.with_suffix(".md"), f"# What permissibility costs PPO\n\n{markdown(table)}\n{of}\n")


if __name__ == "__main__":
    main()
