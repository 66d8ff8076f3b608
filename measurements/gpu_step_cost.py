"""Milliseconds per environment step on a GPU and on the CPU, of every guided algorithm and of its base.

    python measurements/gpu_step_cost.py --device cuda --out results/gpu_step_cost.csv
    python measurements/gpu_step_cost.py --device cpu --out results/gpu_step_cost.csv

Each row is the median of three short runs, in which base and guided model take turns; it is written when it is known.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces

from sb3_sap import DDPGAP, DQNAP, QRDQNAP, SACAP, TD3AP, TQCAP, CrossQAP, PermissibilityCallback
from sb3_sap.common.files import atomic_path

WIDE: dict[str, Any] = {"batch_size": 1024, "policy_kwargs": {"net_arch": [1024, 1024]}}
#: Networks, guided class, settings of both models, steps of one run on a GPU and on the CPU.
CASES: list[tuple[str, Any, dict[str, Any], int, int]] = [
    *(("MLP, defaults", cls, {}, 60, 40) for cls in (DDPGAP, TD3AP, SACAP, TQCAP)),
    ("MLP, defaults", CrossQAP, {}, 60, 12),
    ("MLP, defaults", DQNAP, {}, 200, 200),
    ("MLP, defaults", QRDQNAP, {}, 200, 100),
    *(("[1024, 1024], batch 1024", cls, WIDE, 60, 8) for cls in (TD3AP, SACAP)),
    ("[1024, 1024], batch 1024", DQNAP, WIDE, 120, 40),
    ("CNN, 64 × 64 × 3", SACAP, {}, 40, 8),
    ("CNN, 64 × 64 × 3", DQNAP, {}, 120, 40),
]
#: Steps after which fits with `refit_growth` are measured.
LATE = 10_000


class Column(gym.Env[Any, Any]):
    """A bright column in an image, moved left or right; permissible: it is no further from the middle."""

    def __init__(self, discrete: bool):
        self.observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = spaces.Discrete(3) if discrete else spaces.Box(-1, 1, (1,), np.float32)
        self.x, self.steps = 0.0, 0

    def _image(self) -> Any:
        image = np.zeros((64, 64, 3), np.uint8)
        left = int(np.clip(32 + 20 * self.x, 0, 60))
        image[:, left : left + 4] = 255
        return image

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.steps = float(self.np_random.uniform(-1, 1)), 0
        return self._image(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        before = abs(self.x)
        moved = float(action) - 1 if isinstance(self.action_space, spaces.Discrete) else float(action[0])
        self.x = float(np.clip(self.x + 0.1 * moved, -1.6, 1.6))
        self.steps += 1
        return self._image(), -abs(self.x), False, self.steps >= 50, {"permissible": abs(self.x) <= before}


def build(networks: str, cls: Any, kind: str, settings: dict[str, Any], device: str) -> Any:
    """A model after 300 random steps and, if it is guided, twenty fits of its predictor."""
    images = networks.startswith("CNN")
    if images:
        env: gym.Env[Any, Any] = Column(cls.discrete)
    elif cls.discrete:
        env = gym.make("MountainCar-v0")
    else:
        env = gym.make("sap/LaneKeeping-v0", track="wheel-2", laps=None)
    own: dict[str, Any] = {}
    if kind != "base":
        own = {"min_per_class": 5, "predictor_gradient_steps": 0}
        own |= {"ap_function": "sb3_sap.tasks.mountain_car"} if cls.discrete and not images else {}
        own |= {"refit_growth": 0.001 if cls.discrete else 0.005} if kind == "guided, rare fits" else {}
    model = (cls.__bases__[-1] if kind == "base" else cls)(
        *("CnnPolicy" if images else "MlpPolicy", env),
        **{"seed": 1, "device": device, "learning_starts": 300, "buffer_size": 5_000},
        **copy.deepcopy(settings),
        **own,
    )
    model.learn(300)
    if kind != "base":
        model.predictor_gradient_steps = None
        callback = PermissibilityCallback()
        callback.model = model
        for _ in range(20):
            callback.fit()
        callback.validate()
    model.learn(8, reset_num_timesteps=False)
    if kind == "guided, rare fits":
        model._steps_of_earlier_learns = LATE
    return model


def milliseconds(model: Any, steps: int) -> float:
    """Of one environment step."""
    begin = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    if model.device.type == "cuda":
        th.cuda.synchronize()
    return 1000 * (time.perf_counter() - begin) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    th.set_num_threads(1)
    cuda = options.device == "cuda"
    rows = pd.read_csv(options.out).to_dict("records") if options.out.exists() else []
    for networks, cls, settings, on_gpu, on_cpu in CASES:
        models = {
            kind: build(networks, cls, kind, settings, options.device)
            for kind in ("base", "guided", "guided, rare fits")
        }
        steps = on_gpu if cuda else on_cpu
        runs = [{kind: milliseconds(model, steps) for kind, model in models.items()} for _ in range(3)]
        medians = {kind: round(statistics.median(run[kind] for run in runs), 3) for kind in models}
        device = th.cuda.get_device_name() if cuda else "CPU, one thread"
        rows.append({"networks": networks, "algorithm": cls.__name__, "device": device, **medians})
        print(rows[-1], flush=True)
        with atomic_path(options.out) as temporary:
            pd.DataFrame(rows).to_csv(temporary, index=False)


if __name__ == "__main__":
    main()
