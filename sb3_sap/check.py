"""Whether an AP function is worth learning from, told before a training run is spent on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_sap.action_spaces import check_action_space, check_observation_space
from sb3_sap.advice import advise, describe
from sb3_sap.permissibility import APFunction, resolve
from sb3_sap.quick_classifier import Foresight, foresee
from sb3_sap.trials import label, rollout, stack, try_actions


@dataclass(frozen=True)
class PermissibilityReport:
    """What :func:`check_permissibility` found. ``None`` stands for what could not be measured."""

    n_steps: int
    """Random steps."""
    permissible_rate: float
    """Share of random actions that are labelled permissible."""
    own_row: bool
    """Whether each label depends on its own transition alone, and is the same when asked twice."""
    action_matters: float | None
    """Share of fixed states at which some of the actions are permissible and others are not; with several dimensions
    they are tried together. ``None``: the environment cannot be brought back to a state."""
    label_changes: float | None
    """Mean number of changes of the label along a sweep of one action dimension, at the states where it changes at all:
    1 is a threshold, 2 an interval. ``None`` for finite action spaces, too, whose actions have no order."""
    accuracy: float | None
    """Balanced accuracy of a quick classifier on held-out random transitions. ``None``: one of the classes is too
    rare."""
    accuracy_without_action: float | None
    """The same of a classifier that does not see the action; where it is no lower, the action decides nothing."""
    action_informs: tuple[float, ...] | None
    """For each dimension of the flattened action, the accuracy that the classifier loses when it is shuffled among
    the held-out transitions; about 0 where it says nothing about the label."""
    policy_forbidden: float | None
    """Share of the policy's own actions that are labelled non-permissible; Definition 3 wants zero of a good one."""
    advice: tuple[str, ...] = field(default=())
    """What to look into, a sentence each; empty where nothing speaks against the AP function."""

    def __str__(self) -> str:
        return describe(self)


def check_permissibility(
    env: gym.Env[Any, Any],
    ap_function: APFunction | str | None = None,
    policy: Any = None,
    n_steps: int = 2_000,
    seed: int = 0,
    verbose: bool = True,
) -> PermissibilityReport:
    """Tries an AP function out with random actions and, if there is one, with a good policy.

    The environment is stepped ``n_steps`` times with random actions, as often with the policy, and further to come back
    to a few states, by a reset with the same seed and the same actions: about 3,500 steps with one action dimension,
    170 for each action of a finite space, and with several dimensions from 5,000, where the action always decides, to
    21,000, where it never does. Short episodes make them fewer.

    :param env: one environment, not a vector of them, with a bounded ``Box`` or a ``Discrete`` action space, and with
        observations that SB3 takes: a ``Box``, ``Discrete``, ``MultiDiscrete``, ``MultiBinary``, or a ``Dict`` of them
    :param ap_function: as the algorithms take it: f(s, a | s') or its dotted name; ``None``: ``info["permissible"]``
    :param policy: a good one, with SB3's ``predict``, or a function of one observation that returns an action
    :param n_steps: random steps, at least 100
    :param seed: of everything random here
    :param verbose: whether to print the report
    :return: the report as data
    :raise ValueError: for an environment that cannot be used, labels that are missing or of a wrong shape
    :raise TypeError: for labels that are not bool
    """
    if not isinstance(env, gym.Env):
        raise TypeError(f"`env` must be a single Gymnasium environment, but is {env!r}.")
    given: list[tuple[str, Any, int]] = [("n_steps", n_steps, 100), ("seed", seed, 0)]
    for name, value, least in given:
        if not isinstance(value, Integral) or value < least:
            raise ValueError(f"`{name}` must be a whole number of at least {least}, but is {value!r}.")
    check_action_space("check_permissibility", env.action_space, discrete=None)
    check_observation_space("check_permissibility", env.observation_space)
    function = None if ap_function is None else resolve(ap_function, "ap_function")
    act = None if policy is None else _acting(policy, env.action_space)
    env.action_space.seed(seed)
    walk = rollout(env, lambda _: env.action_space.sample(), n_steps, seed)
    labels = label(walk, function)
    action_matters, label_changes = try_actions(env, function, seed)
    foresight = foresee(env, stack([t.obs for t in walk]), np.stack([t.action for t in walk]), labels, seed)
    findings: dict[str, Any] = {
        "n_steps": n_steps,
        "permissible_rate": float(labels.mean()),
        "own_row": np.array_equal(label(walk[::-1], function)[::-1], labels),
        "action_matters": action_matters,
        "label_changes": label_changes,
        **(dict.fromkeys(Foresight._fields) if foresight is None else foresight._asdict()),
        "policy_forbidden": None,
    }
    if act is not None:
        findings["policy_forbidden"] = float(1 - label(rollout(env, act, n_steps, seed), function).mean())
    report = PermissibilityReport(**findings)
    report = PermissibilityReport(**findings, advice=tuple(advise(report)))
    if verbose:
        print(report)
    return report


def _acting(policy: Any, space: gym.Space[Any]) -> Callable[[Any], Any]:
    if not (hasattr(policy, "predict") or callable(policy)):
        raise TypeError(f"`policy` must have SB3's `predict` or be a function (obs) -> action, but is {policy!r}.")

    def act(obs: Any) -> Any:
        action = policy.predict(obs, deterministic=True)[0] if hasattr(policy, "predict") else policy(obs)
        numbers = np.asarray(action)
        if numbers.dtype.kind not in "biuf" or numbers.shape != space.shape:
            raise ValueError(f"`policy` must return one action of {space} for one observation, but gave {action!r}.")
        return action

    return act
