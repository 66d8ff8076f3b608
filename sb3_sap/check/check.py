"""Checks whether an AP function is worth learning from, before a training run is spent on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any, overload

import gymnasium as gym
import numpy as np

from sb3_sap.check.advice import advise
from sb3_sap.check.classifier import ClassifierResult, fit_classifier
from sb3_sap.check.parts import InfoOfPart, OfPart
from sb3_sap.check.report import PermissibilityReport
from sb3_sap.check.trials import label, rollout, try_actions
from sb3_sap.common.acting import Actor
from sb3_sap.common.action_parts import ActionParts
from sb3_sap.common.arrays import stack_observations
from sb3_sap.common.functions import resolve
from sb3_sap.common.spaces import check_action_space, check_observation_space
from sb3_sap.permissibility import APFunction


@overload
def check_permissibility(
    env: gym.Env[Any, Any],
    ap_function: APFunction | str | None = None,
    policy: Any = None,
    n_steps: int = 2_000,
    seed: int = 0,
    verbose: bool = True,
    action_parts: None = None,
) -> PermissibilityReport: ...


@overload
def check_permissibility(
    env: gym.Env[Any, Any],
    ap_function: APFunction | str | None = None,
    policy: Any = None,
    n_steps: int = 2_000,
    seed: int = 0,
    verbose: bool = True,
    *,
    action_parts: Mapping[str, Sequence[int]],
) -> dict[str, PermissibilityReport]: ...


def check_permissibility(
    env: gym.Env[Any, Any],
    ap_function: APFunction | str | None = None,
    policy: Any = None,
    n_steps: int = 2_000,
    seed: int = 0,
    verbose: bool = True,
    action_parts: Mapping[str, Sequence[int]] | None = None,
) -> PermissibilityReport | dict[str, PermissibilityReport]:
    """Tries an AP function with random actions and, if one is given, with a good policy.

    The environment is stepped ``n_steps`` times with random actions, and as often with the policy. Further steps return
    to a few states, by a reset with the same seed and the same actions, to try several actions in each: about 3,500
    steps with one action dimension, 170 for each action of a ``Discrete`` space, and with several dimensions between
    5,000, where the action always decides, and 21,000, where it never does. Short episodes reduce these numbers.

    :param env: one environment, not a vector of them, with a bounded ``Box`` or a ``Discrete`` action space, and with
        observations that SB3 takes: a ``Box``, ``Discrete``, ``MultiDiscrete``, ``MultiBinary``, or a ``Dict`` of them
    :param ap_function: as the algorithms take it: f(s, a | s') or its dotted name; ``None``: ``info["permissible"]``
    :param policy: a good policy, with SB3's ``predict``, or a function of one observation that returns an action
    :param n_steps: random steps, at least 100
    :param seed: of all random draws
    :param verbose: whether to print the report
    :param action_parts: as the algorithms take them; each part is checked by itself, so that it takes as many times as
        many steps
    :return: the report as data; with ``action_parts`` one for each of them, by name
    :raise ValueError: for an environment that cannot be used, labels that are missing or of a wrong shape
    :raise TypeError: for labels that are not bool
    """
    if not isinstance(env, gym.Env):
        raise TypeError(f"`env` must be a single Gymnasium environment, but is {env!r}.")
    given: list[tuple[str, Any, int]] = [("n_steps", n_steps, 100), ("seed", seed, 0)]
    for name, value, minimum in given:
        if not isinstance(value, Integral) or value < minimum:
            raise ValueError(f"`{name}` must be a whole number of at least {minimum}, but is {value!r}.")
    check_action_space("check_permissibility", env.action_space, discrete=None)
    check_observation_space("check_permissibility", env.observation_space)
    function = None if ap_function is None else resolve(ap_function, "ap_function")
    if action_parts is not None:
        names = ActionParts.of(action_parts, env.action_space).names
        reports = {}
        for number, name in enumerate(names):
            if verbose:
                print(f"{name}:")
            of_part = None if function is None else OfPart(function, names, number)
            judged = InfoOfPart(env, names, number) if function is None else env
            reports[name] = check_permissibility(judged, of_part, policy, n_steps, seed, verbose)
        return reports
    act = None if policy is None else _action_function(policy, env.action_space)
    env.action_space.seed(seed)
    transitions = rollout(env, lambda *_: env.action_space.sample(), n_steps, seed)
    labels = label(transitions, function)
    action_matters, label_changes = try_actions(env, function, seed)
    result = fit_classifier(
        env, stack_observations([t.obs for t in transitions]), np.stack([t.action for t in transitions]), labels, seed
    )
    findings: dict[str, Any] = {
        "n_steps": n_steps,
        "permissible_rate": float(labels.mean()),
        "own_row": np.array_equal(label(transitions[::-1], function)[::-1], labels),
        "action_matters": action_matters,
        "label_changes": label_changes,
        **(dict.fromkeys(ClassifierResult._fields) if result is None else result._asdict()),
        "policy_forbidden": None,
    }
    if act is not None:
        findings["policy_forbidden"] = float(1 - label(rollout(env, act, n_steps, seed), function).mean())
    report = PermissibilityReport(**findings)
    report = PermissibilityReport(**findings, advice=tuple(advise(report)))
    if verbose:
        print(report)
    return report


def _action_function(policy: Any, space: gym.Space[Any]) -> Callable[[Any, bool], Any]:
    if not (hasattr(policy, "predict") or callable(policy)):
        raise TypeError(f"`policy` must have SB3's `predict` or be a function (obs) -> action, but is {policy!r}.")

    actor = Actor(policy) if hasattr(policy, "predict") else None

    def act(obs: Any, starts: bool) -> Any:
        action = policy(obs) if actor is None else actor(obs, starts)
        numbers = np.asarray(action)
        if numbers.dtype.kind not in "biuf" or numbers.shape != space.shape:
            raise ValueError(f"`policy` must return one action of {space} for one observation, but gave {action!r}.")
        return action

    return act
