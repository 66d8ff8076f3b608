"""Small on-policy models, and classifiers whose verdicts can be computed in the head."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import sb3_contrib
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stubs import StubPredictor
from toy import Line, towards_centre

from sb3_sap import A2CAP, PPOAP, TRPOAP, RecurrentPPOAP

BASES = {
    PPOAP: stable_baselines3.PPO,
    A2CAP: stable_baselines3.A2C,
    TRPOAP: sb3_contrib.TRPO,
    RecurrentPPOAP: sb3_contrib.RecurrentPPO,
}
MULTI_DISCRETE = spaces.MultiDiscrete([3, 2])
MULTI_BINARY = spaces.MultiBinary(3)


class Recorder(gym.Env[Any, Any]):
    """Observes (steps, 1) of an episode of 10 steps and records every (steps, action); the reward is the action."""

    def __init__(self, action_space: Any):
        self.action_space = action_space
        self.observation_space = spaces.Box(0, 10, (2,), np.float32)
        self.executed: list[tuple[int, np.ndarray[Any, Any]]] = []
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.array([0, 1], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.executed.append((self.steps, np.copy(action)))
        self.steps += 1
        return np.array([self.steps, 1], np.float32), float(np.sum(action)), False, self.steps >= 10, {}

    def action_masks(self) -> Any:
        """For MaskablePPO: the verdicts of :func:`even`."""
        return (np.arange(self.action_space.n) + self.steps) % 2 == 0


def even(obs: Any, actions: th.Tensor) -> th.Tensor:
    """Logits that permit a joint action if its sum and the step are together even."""
    together = obs[:, 0].long() + actions.long().reshape(len(actions), -1).sum(dim=1)
    return 1.0 - 2.0 * (together % 2)


def permit(obs: Any, actions: th.Tensor) -> th.Tensor:
    return th.ones(len(actions))


def never_labels(obs: Any, actions: Any, next_obs: Any) -> Any:
    return np.zeros(len(actions), dtype=bool)


def settings(algorithm: Any, **overrides: Any) -> dict[str, Any]:
    """Those of the smallest model; an algorithm of this package gets a small E, too."""
    recurrent = algorithm in (RecurrentPPOAP, BASES[RecurrentPPOAP])
    found: dict[str, Any] = {"n_steps": 16, "seed": 1, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    if recurrent:
        found["policy_kwargs"] |= {"lstm_hidden_size": 4}
    if algorithm not in (A2CAP, BASES[A2CAP]):
        found["batch_size"] = 16
    if algorithm not in (A2CAP, BASES[A2CAP], TRPOAP, BASES[TRPOAP]):
        found["n_epochs"] = 2
    if algorithm in BASES:
        found |= {"dataset_size": 16, "validation_size": 8, "min_per_class": 2, "ap_function": towards_centre}
        found["predictor_kwargs"] = {"net_arch": [8], "batch_size": 16}
    return found | overrides


def build_on_policy(algorithm: Any, env: Any = None, **overrides: Any) -> Any:
    recurrent = algorithm in (RecurrentPPOAP, BASES[RecurrentPPOAP])
    policy = overrides.pop("policy", "MlpLstmPolicy" if recurrent else "MlpPolicy")
    return algorithm(policy, Line() if env is None else env, **settings(algorithm, **overrides))


class Agrees:
    """In place of an `Agreement`: advantages that agree with the labels as far as possible."""

    def update(self, labels: Any, advantages: Any) -> None:
        pass

    def __float__(self) -> float:
        return 1.0


def judged_by(logits_of: Any, algorithm: Any = PPOAP, env: Any = None, **overrides: Any) -> Any:
    """A model with a classifier of known verdicts, which has passed its gate, is trusted, and fits nothing."""
    model = build_on_policy(algorithm, env, **({"ap_function": never_labels} | overrides))
    model.predictor = StubPredictor(logits_of)
    model.validation_accuracy = 1.0
    model.agreement = Agrees()
    model.set_logger(Logger(None, []))
    return model


def weights(model: Any) -> dict[str, th.Tensor]:
    """The policy's, and the state of its optimizer."""
    state = model.policy.optimizer.state_dict()["state"]
    moments = {f"optimizer.{i}.{key}": th.as_tensor(v) for i, entry in state.items() for key, v in entry.items()}
    return dict(model.policy.state_dict()) | moments


def assert_same_learning(one: Any, other: Any) -> None:
    """The same weights and the same last rollout, to the bit."""
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    for name, value in a.items():
        assert th.equal(value, b[name]), name
    for name in ("observations", "actions", "rewards", "log_probs", "advantages"):
        np.testing.assert_array_equal(*(getattr(m.rollout_buffer, name) for m in (one, other)), err_msg=name)
