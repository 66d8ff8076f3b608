"""Measures what masks are worth to PPO where there are 6,561 combinations: eight dimensions of three choices.

PPO alone; with the label as a penalty; with one label of the whole action, whose masks are drawn one block after the
other; with a label for each dimension; and with known masks. Each entry is the mean return of twenty episodes, of at
most 50, drawn from the distribution that was trained, masks included. `policy alone` leaves out what E learned.

The learning rate and the best penalty were chosen by the search, on seeds 100 and 101.

python measurements/many_combinations.py            # writes results/many_combinations.csv and .md
python measurements/many_combinations.py --search   # writes results/tuning/many_combinations.csv
"""

import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_sap import PPOAP, ActionMaskObservation, preset
from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text

SEEDS, STEPS, EPISODES, DIMENSIONS = range(1120, 1130), 2_048, 20, 8


class Switches(gym.Env[Any, Any]):
    """Eight switches of three positions: the reward is the share that stand as their lamps say, for 50 steps.

    A lamp shows a number from -1 to 1, whose thirds are the positions. Position 0 below a lamp of the highest third
    breaks something, and so does position 2 below one of the lowest third.
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


CASES: dict[str, dict[str, Any]] = {
    "PPO alone": {"ap_function": all_switches, "alpha": 0},
    "the preset of the penalty": {"ap_function": all_switches, **preset("penalty", PPOAP)},
    "the best penalty": {"ap_function": all_switches, **preset("penalty", PPOAP), "penalty": 1.0},
    "the best that follows the rewards": {"ap_function": all_switches, **preset("penalty", PPOAP), "penalty": "auto"},
    "loss": {"ap_function": all_switches, **preset("loss", PPOAP)},
    "one label, block after block": {"ap_function": all_switches},
    "a label for each dimension": {
        "ap_function": each_switch,
        "action_parts": {f"switch {i}": [i] for i in range(DIMENSIONS)},
    },
    "known masks": {"policy": "MultiInputPolicy", "permissible_actions": "action_mask", "alpha": 0},
}


#: What the search chose from.
RATES, PENALTIES = (1e-3, 3e-3), (0.1, 1.0, "auto_0.25", "auto")


def measure(case: dict[str, Any], seed: int) -> dict[str, Any]:
    """The returns of a run at its end."""
    known = "permissible_actions" in case

    def env() -> Any:
        return Monitor(ActionMaskObservation(Switches()) if known else Switches())

    settings: dict[str, Any] = {"policy": "MlpPolicy", "n_steps": 256, "predictor_epochs": 2, "learning_rate": 3e-3}
    begun = time.process_time()
    model = PPOAP(env=env(), seed=seed, device="cpu", **settings | case).learn(STEPS)
    spent = time.process_time() - begun

    def score(agent: Any) -> float:
        test = env()
        test.reset(seed=10_000 + seed)
        return float(np.mean(evaluate_policy(agent, test, EPISODES, deterministic=False)[0]))

    bad, good = model.knowledge.seen
    alone = SimpleNamespace(predict=partial(model.predict, guided=False))
    row = {"return": score(model), "alone": score(alone), "seconds": spent}
    return row | {"mistakes": bad / max(1, bad + good), "accuracy": model.validation_accuracy}


def search() -> None:
    """The mean return of each learning rate without a label, with each penalty, and with masks from labels."""
    tried = {name: CASES[name] for name in ("PPO alone", "one label, block after block", "a label for each dimension")}
    tried |= {f"penalty {size}": CASES["the best penalty"] | {"penalty": size} for size in PENALTIES}
    rows = []
    for name, case in tried.items():
        for rate in RATES:
            found = [measure(case | {"learning_rate": rate}, seed)["return"] for seed in (100, 101)]
            rows.append({"masks": name, "learning rate": rate, "return": round(float(np.mean(found)), 2)})
            print(rows[-1], flush=True)
    write_csv(Path("results/tuning/many_combinations.csv"), pd.DataFrame(rows))


def main() -> None:
    th.set_num_threads(1)
    if sys.argv[1:] == ["--search"]:
        search()
        return
    made, rows = provenance(), []
    for name, settings in CASES.items():
        found = pd.DataFrame([measure(settings, seed) for seed in SEEDS])
        row = {"masks": name, "seeds": len(SEEDS), "steps": f"{STEPS:,}"}
        row |= {title: f"{found[key].mean():.1f} ({found[key].min():.1f})" for title, key in RETURNS.items()}
        labelled = "ap_function" in settings
        row["mistakes"] = f"{found['mistakes'].mean():.1%}" if labelled else ""
        row["accuracy of E"] = f"{found['accuracy'].mean():.2f}" if labelled else ""
        rows.append(row | {"ms per step": f"{1000 * found['seconds'].mean() / STEPS:.1f}"})
        print(rows[-1], flush=True)
    table, path = pd.DataFrame(rows), Path("results/many_combinations.csv")
    write_csv(path, table)
    of = f"Means over seeds {SEEDS[0]} to {SEEDS[-1]}, the worst in brackets; on {made['machine']}, {made['date']}, "
    of += f"{made['revision']}."
    write_text(path.with_suffix(".md"), f"# Masks of 6,561 combinations, with PPO\n\n{markdown(table)}\n{of}\n")


RETURNS = {"return": "return", "policy alone": "alone"}

if __name__ == "__main__":
    main()
