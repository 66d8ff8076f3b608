"""Measures what masks are worth to on-policy algorithms, on two small tasks and design seeds.

Acrobot with A2C, TRPO and recurrent PPO, each alone and with a learned mask. And a task with 6,561 combinations, eight
dimensions of three choices, with PPO: alone; with one label of the whole action, whose masks are drawn one block after
the other; with a label for each dimension; and with known masks.

Each entry is the mean return of twenty episodes, drawn from the distribution that was trained, masks included. `policy
alone` leaves out what E learned, at the end.

python measurements/on_policy_tasks.py [--tasks acrobot switches]   # writes results/on_policy_tasks.csv and .md
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
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_sap import A2CAP, PPOAP, TRPOAP, ActionMaskObservation, GuidedPolicy, RecurrentPPOAP, tasks
from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text

SEEDS, EPISODES, DIMENSIONS = (100, 101, 102), 20, 8


class Switches(gym.Env[Any, Any]):
    """Eight switches of three positions: the reward is the share that stand as their lamps say, for 50 steps.

    A lamp shows a number from -1 to 1, whose thirds are the positions. Position 0 below one of the highest third, and
    position 2 below one of the lowest third, break something.
    """

    observation_space = spaces.Box(-1.0, 1.0, (DIMENSIONS,), np.float32)
    action_space = spaces.MultiDiscrete([3] * DIMENSIONS)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = float((np.asarray(action) == thirds(self._obs)).mean())
        self._steps += 1
        return self._observe(), reward, False, self._steps == 50, {}

    def action_masks(self) -> Any:
        allowed = np.ones((DIMENSIONS, 3), dtype=bool)
        third = thirds(self._obs)
        allowed[third == 2, 0] = allowed[third == 0, 2] = False
        return allowed.ravel()

    def _observe(self) -> Any:
        self._obs = self.np_random.uniform(-1, 1, DIMENSIONS).astype(np.float32)
        return self._obs


def thirds(obs: Any) -> Any:
    """0, 1 or 2 for each number from -1 to 1."""
    return np.clip(np.floor((obs + 1) * 1.5), 0, 2).astype(int)


def each_switch(obs: Any, actions: Any, next_obs: Any) -> Any:
    """(n, 8) bool, which switches break nothing."""
    return np.abs(actions - thirds(obs)) < 2


def all_switches(obs: Any, actions: Any, next_obs: Any) -> Any:
    """(n,) bool, whether none does."""
    return each_switch(obs, actions, next_obs).all(axis=1)


class Case(NamedTuple):
    """What is trained.

    :param cls: of the model
    :param settings: its constructor arguments
    :param masked: whether the masks are known, and in the observation
    """

    cls: Any
    settings: dict[str, Any]
    masked: bool = False


ACROBOT = {"ap_function": tasks.acrobot}
PARTS = {"action_parts": {f"switch {i}": [i] for i in range(DIMENSIONS)}}
TASKS: dict[str, tuple[Callable[[], Any], int, dict[str, Case]]] = {
    "acrobot": (
        lambda: gym.make("Acrobot-v1"),
        10_240,
        {
            f"{name}, {way}": Case(cls, ACROBOT | more | {"alpha": alpha})
            for name, cls, more in (
                ("A2C", A2CAP, {"n_steps": 16}),
                ("TRPO", TRPOAP, {"n_steps": 512}),
                ("recurrent PPO", RecurrentPPOAP, {"n_steps": 512, "policy": "MlpLstmPolicy"}),
            )
            for way, alpha in (("alone", 0), ("learned mask", 1))
        },
    ),
    "switches": (
        Switches,
        4_096,
        {
            "PPO, alone": Case(PPOAP, {"ap_function": all_switches, "alpha": 0}),
            "PPO, learned mask, one label": Case(PPOAP, {"ap_function": all_switches}),
            "PPO, learned masks, labels per part": Case(PPOAP, {"ap_function": each_switch} | PARTS),
            "PPO, known masks": Case(
                PPOAP, {"policy": "MultiInputPolicy", "permissible_actions": "action_mask", "alpha": 0}, masked=True
            ),
        },
    ),
}


def measure(task: str, name: str, seed: int) -> dict[str, Any]:
    """The returns of a run after half of its steps and at the end."""
    make, steps, cases = TASKS[task]
    case = cases[name]

    def env() -> Any:
        return Monitor(ActionMaskObservation(make()) if case.masked else make())

    settings: dict[str, Any] = {"policy": "MlpPolicy", "n_steps": 256, "seed": seed, "device": "cpu"}
    settings |= {"predictor_epochs": 2} | case.settings
    model, begun, row = case.cls(env=env(), **settings), time.process_time(), {}
    guided = bool(case.settings.get("alpha", 1))

    def score(agent: Any) -> float:
        test = env()
        test.reset(seed=10_000 + seed)
        return float(evaluate_policy(agent, test, EPISODES, deterministic=False)[0])

    for after in (steps // 2, steps):
        model.learn(steps // 2, reset_num_timesteps=after < steps)
        row[after] = score(GuidedPolicy(model) if guided else model)
    row["alone"] = score(model)
    bad, good = model.knowledge.seen
    return row | {
        "mistakes": bad / max(1, bad + good),
        "E": model.validation_accuracy,
        "s": time.process_time() - begun,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--out", type=Path, default=Path("results/on_policy_tasks.csv"))
    options = parser.parse_args()
    th.set_num_threads(1)
    made, rows = provenance(), []
    for task in options.tasks:
        _, steps, cases = TASKS[task]
        for name, case in cases.items():
            found = pd.DataFrame([measure(task, name, seed) for seed in SEEDS])
            row = {"task": task, "configuration": name, "seeds": len(SEEDS)}
            for after, title in ((steps // 2, "after half"), (steps, "at the end"), ("alone", "policy alone")):
                row[title] = f"{found[after].mean():.1f} ({found[after].min():.1f})"
            row |= {"steps": f"{steps:,}", "ms per step": f"{1000 * found['s'].mean() / steps:.1f}"}
            row["mistakes"] = "" if case.masked else f"{found['mistakes'].mean():.1%}"
            row["accuracy of E"] = "" if case.masked else f"{found['E'].mean():.2f}"
            rows.append(row)
            print(row, flush=True)
    table = pd.DataFrame(rows)
    write_csv(options.out, table)
    of = (
        f"Means over seeds 100 to 102, the worst in brackets; on {made['machine']}, {made['date']}, {made['revision']}."
    )
    title = "What masks are worth to on-policy algorithms on two small tasks"
    write_text(options.out.with_suffix(".md"), f"# {title}\n\n{markdown(table)}\n{of}\n")


if __name__ == "__main__":
    main()
