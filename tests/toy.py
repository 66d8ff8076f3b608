"""A point on a line: a problem in which every consequence can be computed in the head."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_sap import DDPG, DDPGAP, DDPGAPCE2, DDPGCE1, DDPGCE2, DQNAP, QRDQNAP, SACAP, TD3AP, TQCAP, CrossQAP

GUIDED = (DDPGAP, DDPGAPCE2, TD3AP, SACAP, TQCAP, CrossQAP)
DISCRETE = (DQNAP, QRDQNAP)
CONSTRAINED = (DDPGCE1, DDPGCE2, DDPGAPCE2)
ALGORITHMS = (DDPG, DDPGCE1, DDPGCE2, *GUIDED)


class Line(gym.Env[Any, Any]):
    """x' = x + 0.1·(mean of the action, scaled to [-1, 1]); permissible where |x'| <= |x|.

    :param kind: "array" observes (x, steps / horizon), "dict" the same in two keys, "goal" as HER needs it
    :param low: lower bound of each of the ``dim`` actions
    :param high: upper bound of each
    :param labels: whether ``info`` holds "permissible"
    :param reuse: whether every observation is the same array, overwritten
    :param n_actions: that many discrete actions, evenly from left to right, instead of continuous ones
    """

    def __init__(
        self,
        kind: str = "array",
        dim: int = 1,
        low: float = -1.0,
        high: float = 1.0,
        labels: bool = True,
        reuse: bool = False,
        horizon: int = 10,
        action_dtype: Any = np.float32,
        n_actions: int | None = None,
    ):
        self.kind, self.labels, self.reuse, self.horizon = kind, labels, reuse, horizon
        box = spaces.Box(low, high, (dim,), action_dtype)
        self.action_space: Any = box if n_actions is None else spaces.Discrete(n_actions)
        plain = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        number = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.observation_space = {
            "array": plain,
            "dict": spaces.Dict({"x": number, "time": number}),
            "goal": spaces.Dict({"observation": plain, "achieved_goal": number, "desired_goal": number}),
        }[kind]
        self.executed: list[np.ndarray[Any, Any]] = []  # every action of any episode
        self._array = np.zeros(2, dtype=np.float32)
        self.x, self.steps = 0.0, 0

    def _observe(self) -> Any:
        values = np.array([self.x, self.steps / self.horizon], dtype=np.float32)
        if self.kind == "dict":
            return {"x": values[:1], "time": values[1:]}
        if self.kind == "goal":
            return {"observation": values, "achieved_goal": values[:1], "desired_goal": np.zeros(1, dtype=np.float32)}
        if not self.reuse:
            return values
        self._array[:] = values
        return self._array

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.steps = float((options or {}).get("x", self.np_random.uniform(-1, 1))), 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.executed.append(np.copy(action))
        space = self.action_space
        before = self.x
        if isinstance(space, spaces.Discrete):
            self.x += 0.1 * float(2 * action / (space.n - 1) - 1)
        else:
            self.x += 0.1 * float(np.mean(2 * (action - space.low) / (space.high - space.low) - 1))
        self.steps += 1
        info = {"permissible": bool(abs(self.x) <= abs(before))} if self.labels else {}
        return self._observe(), -abs(self.x), False, self.steps >= self.horizon, info

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.abs(achieved - desired).reshape(-1)


def towards_centre(obs: Any, actions: Any, next_obs: Any) -> Any:
    """The AP function of :class:`Line`, for a batch."""
    x, next_x = (o["x"] if isinstance(o, dict) else o[:, :1] for o in (obs, next_obs))
    return (np.abs(next_x) <= np.abs(x))[:, 0]


def centred(obs: Any) -> Any:
    """A potential of :class:`Line`: the AP function above permits what does not lower it."""
    x = obs["x"] if isinstance(obs, dict) else obs[:, :1]
    return -np.abs(x)[:, 0].astype(float)


def nearby(obs: Any, previous_obs: Any, last_action: Any) -> tuple[Any, Any]:
    """A stub constraint: within 0.5 of the previous action."""
    return last_action - 0.5, last_action + 0.5


NOT_A_FUNCTION = 3


def build(algorithm: Any, env: Any = None, **overrides: Any) -> Any:
    """A model small enough that hundreds of steps take a moment."""
    settings: dict[str, Any] = {
        "learning_starts": 10,
        "buffer_size": 600,
        "batch_size": 8,
        "policy_kwargs": {"net_arch": [8]},
        "seed": 1,
        "device": "cpu",
    }
    if algorithm in GUIDED + DISCRETE:
        settings |= {
            "dataset_size": 16,
            "validation_size": 8,
            "min_per_class": 2,
            "predictor_kwargs": {"net_arch": [8], "batch_size": 16},
        }
    if algorithm in CONSTRAINED:
        settings |= {"constraint": nearby}
    policy = overrides.pop("policy", "MlpPolicy")
    if env is None:
        env = Line(n_actions=3) if algorithm in DISCRETE else Line()
    return algorithm(policy, env, **(settings | overrides))


#: Settings of K and E with which they are fitted to a few hundred examples.
SMALL_FITS = {
    "dataset_size": 128,
    "predictor_kwargs": {"net_arch": [32], "batch_size": 64, "learning_rate": 0.01},
    "min_per_class": 2,
}


def line_log(n=2_000, seed=0, kind="array", wrong=False, reward=True):
    """Independent steps from random places on the line."""
    rng = np.random.default_rng(seed)
    x, actions = rng.uniform(-1, 1, (n, 1)).astype(np.float32), rng.uniform(-1, 1, (n, 1)).astype(np.float32)
    next_x, time = x + 0.1 * actions, np.full((n, 1), 0.5, np.float32)

    def observed(values):
        return {"x": values, "time": time} if kind == "dict" else np.hstack([values, time])

    log = {"obs": observed(x), "actions": actions, "next_obs": observed(next_x)}
    if reward:
        log["rewards"] = -np.abs(next_x[:, 0])
    if wrong:
        log["labels"] = (np.abs(next_x) > np.abs(x))[:, 0]
    return log
