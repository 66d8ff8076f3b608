"""Whether an AP function is worth learning from, told before a training run is spent on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor

from sb3_sap.action_spaces import check_action_space
from sb3_sap.advice import advise, describe
from sb3_sap.knowledge import KnowledgeBuffer
from sb3_sap.permissibility import APFunction, BoolArray, ask, copy_observation, labels_from_infos, resolve
from sb3_sap.predictor import PermissibilityPredictor

#: States at which a sweep of actions is tried, each this many random steps or fewer after a reset.
N_STATES, MAX_PREFIX = 16, 20
#: Actions of one sweep, from the lowest to the highest.
N_ACTIONS = 21
#: Of the random transitions, the share that the quick classifier never sees; its fits, and the examples of each.
HELD_OUT, FITS, DATASET_SIZE = 0.2, 120, 512


class Transition(NamedTuple):
    """One executed step, in the environment's own units."""

    obs: Any
    action: Any
    next_obs: Any
    info: dict[str, Any]


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
    """Share of fixed states at which some of the actions are permissible and others are not. ``None``: the environment
    cannot be brought back to a state."""
    label_changes: float | None
    """Mean number of changes of the label along a sweep of one action dimension, at the states where it changes at all:
    1 is a threshold, 2 an interval. ``None`` for finite action spaces, too, whose actions have no order."""
    accuracy: float | None
    """Balanced accuracy of a quick classifier on held-out random transitions. ``None``: one of the classes is too
    rare."""
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

    The environment is stepped about ``n_steps`` times with random actions, as often with the policy, and some 4,000
    times to come back to a few states: it is brought there by a reset with the same seed and the same actions.

    :param env: with a bounded ``Box`` or a ``Discrete`` action space; one environment, not a vector of them
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
    if n_steps < 100:
        raise ValueError(f"`n_steps` must be at least 100, but is {n_steps}.")
    check_action_space("check_permissibility", env.action_space, isinstance(env.action_space, spaces.Discrete))
    function = None if ap_function is None else resolve(ap_function, "ap_function")
    env.action_space.seed(seed)
    walk = _rollout(env, lambda _: env.action_space.sample(), n_steps, seed)
    labels = _labels(walk, function)
    action_matters, label_changes = _sweeps(env, function, seed)
    findings: dict[str, Any] = {
        "n_steps": n_steps,
        "permissible_rate": float(labels.mean()),
        "own_row": np.array_equal(_labels(walk[::-1], function)[::-1], labels),
        "action_matters": action_matters,
        "label_changes": label_changes,
        "accuracy": _held_out_accuracy(env, walk, labels, seed),
        "policy_forbidden": None,
    }
    if policy is not None:
        act = _acting(policy)
        findings["policy_forbidden"] = float(1 - _labels(_rollout(env, act, n_steps, seed), function).mean())
    report = PermissibilityReport(**findings)
    report = PermissibilityReport(**findings, advice=tuple(advise(report)))
    if verbose:
        print(report)
    return report


def _rollout(env: gym.Env[Any, Any], act: Callable[[Any], Any], n_steps: int, seed: int) -> list[Transition]:
    walk: list[Transition] = []
    obs, _ = env.reset(seed=seed)
    while len(walk) < n_steps:
        obs = copy_observation(obs)
        action = act(obs)
        next_obs, _, terminated, truncated, info = env.step(action)
        walk.append(Transition(obs, action, copy_observation(next_obs), info))
        obs = env.reset()[0] if terminated or truncated else next_obs
    return walk


def _acting(policy: Any) -> Callable[[Any], Any]:
    if hasattr(policy, "predict"):
        return lambda obs: policy.predict(obs, deterministic=True)[0]
    if not callable(policy):
        raise TypeError(f"`policy` must have SB3's `predict` or be a function (obs) -> action, but is {policy!r}.")
    return policy  # type: ignore[no-any-return]


def _labels(transitions: list[Transition], function: APFunction | None) -> BoolArray:
    if function is None:
        return labels_from_infos([transition.info for transition in transitions])
    obs, next_obs = _stack([t.obs for t in transitions]), _stack([t.next_obs for t in transitions])
    return ask(function, "ap_function", obs, np.stack([t.action for t in transitions]), next_obs)


def _stack(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)


def _held_out_accuracy(env: gym.Env[Any, Any], walk: list[Transition], labels: BoolArray, seed: int) -> float | None:
    """Balanced accuracy of an E that was fitted as a model fits it, on examples of K that it never saw."""
    space: Any = env.action_space
    obs, actions = _stack([t.obs for t in walk]), np.stack([t.action for t in walk])
    if isinstance(space, spaces.Box):
        actions = 2 * (actions - space.low) / (space.high - space.low) - 1
    actions = actions.reshape(len(walk), -1)
    knowledge = KnowledgeBuffer(env.observation_space, actions.shape[1], 2 * len(walk), HELD_OUT, seed)
    knowledge.add(obs, actions, labels)
    if min(min(knowledge.counts("train")), min(knowledge.counts("validation"))) < 10:
        return None
    keyed = isinstance(env.observation_space, spaces.Dict)
    with th.random.fork_rng(devices=[]):  # the caller's generator is left alone
        th.default_generator.manual_seed(seed)
        predictor = PermissibilityPredictor(
            env.observation_space, space, features_extractor_class=CombinedExtractor if keyed else FlattenExtractor
        )
    for _ in range(FITS):
        predictor.fit(knowledge.sample(DATASET_SIZE))
    return float(np.mean(predictor.recall(knowledge.sample(len(walk), "validation"))))


def _sweeps(env: gym.Env[Any, Any], function: APFunction | None, seed: int) -> tuple[float | None, float | None]:
    """How the label depends on the action alone: ``action_matters`` and ``label_changes`` of the report."""
    rng = np.random.default_rng(seed)
    changes = []
    for state in range(N_STATES):
        prefix = [env.action_space.sample() for _ in range(rng.integers(MAX_PREFIX))]
        sweep: list[Transition] = []
        for action in _sweep_actions(env.action_space, rng):
            transition = _step_from(env, seed + state, prefix, action)
            if sweep and not _same(transition.obs, sweep[0].obs):
                return None, None
            sweep.append(transition)
        changes.append(int(np.count_nonzero(np.diff(_labels(sweep, function)))))
    changed = [number for number in changes if number > 0]
    ordered = changed and isinstance(env.action_space, spaces.Box)
    return len(changed) / len(changes), float(np.mean(changed)) if ordered else None


def _sweep_actions(space: Any, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """Every action of a finite space; else N_ACTIONS along one dimension, the others held at random values."""
    if isinstance(space, spaces.Discrete):
        return np.arange(space.start, space.start + space.n)
    actions = np.repeat(rng.uniform(space.low, space.high)[None], N_ACTIONS, axis=0)
    column = actions.reshape(N_ACTIONS, -1)
    dimension = rng.integers(column.shape[1])
    column[:, dimension] = np.linspace(space.low.flat[dimension], space.high.flat[dimension], N_ACTIONS)
    return actions.astype(space.dtype)


def _step_from(env: gym.Env[Any, Any], seed: int, prefix: list[Any], action: Any) -> Transition:
    obs, _ = env.reset(seed=seed)
    for earlier in prefix:
        reached, _, terminated, truncated, _ = env.step(earlier)
        if terminated or truncated:  # sooner than meant: what was reached before would be another state
            obs, _ = env.reset(seed=seed)
            break
        obs = reached
    obs = copy_observation(obs)
    next_obs, _, _, _, info = env.step(action)
    return Transition(obs, action, copy_observation(next_obs), info)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return all(np.array_equal(one[key], other[key]) for key in one)
    return np.array_equal(one, other)
