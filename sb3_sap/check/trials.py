"""Rollouts with random actions, and different actions in the same state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, copy_observation, same_observation, stack_observations
from sb3_sap.permissibility import APFunction, labels_from_infos, query_labels

#: Number of states in which actions are tried: with one action dimension or discrete actions, and with several.
N_STATES, N_STATES_SEVERAL = 16, 24
#: Each of these states is reached by fewer random steps than this after a reset.
MAX_PREFIX = 20
#: Actions of one sweep along a dimension, from the lowest to the highest.
N_ACTIONS = 21
#: Random actions, in all dimensions at once, that are tried in a state where the sweep did not change the label.
N_JOINT = 64


class Transition(NamedTuple):
    """One executed step, in the environment's own units."""

    obs: Any
    action: Any
    next_obs: Any
    info: dict[str, Any]


def rollout(env: gym.Env[Any, Any], act: Callable[[Any, bool], Any], n_steps: int, seed: int) -> list[Transition]:
    """Steps through an environment, from episode to episode.

    :param act: chooses the action for an observation, and whether an episode begins with it
    """
    transitions: list[Transition] = []
    obs, starts = _reset(env, seed), True
    while len(transitions) < n_steps:
        obs = copy_observation(obs)
        action = act(obs, starts)
        next_obs, starts, info = _step(env, action)
        transitions.append(Transition(obs, action, copy_observation(next_obs), info))
        obs = _reset(env, None) if starts else next_obs
    return transitions


def label(transitions: list[Transition], function: APFunction | None) -> BoolArray:
    """(n,) labels of n transitions, by the AP function or, without one, by ``info["permissible"]``."""
    if function is None:
        return labels_from_infos([transition.info for transition in transitions])
    obs, next_obs = (
        stack_observations([t.obs for t in transitions]),
        stack_observations([t.next_obs for t in transitions]),
    )
    return query_labels(function, "ap_function", obs, np.stack([t.action for t in transitions]), next_obs)


def try_actions(env: gym.Env[Any, Any], function: APFunction | None, seed: int) -> tuple[float | None, float | None]:
    """How the label depends on the action in a fixed state: ``action_matters`` and ``label_changes`` of the report."""
    space, rng = env.action_space, np.random.default_rng(seed)
    several = isinstance(space, spaces.Box) and space.low.size > 1
    decides, changes = [], []
    for state in range(seed, seed + (N_STATES_SEVERAL if several else N_STATES)):
        prefix = [space.sample() for _ in range(rng.integers(MAX_PREFIX))]
        sweep: list[Transition] = []
        for action in _sweep_actions(space, rng):
            sweep.append(_step_from(env, state, prefix, action))
            if not same_observation(sweep[-1].obs, sweep[0].obs):
                return None, None
        labels = label(sweep, function)
        changes.append(int(np.count_nonzero(np.diff(labels))))
        # A sweep of one dimension rarely changes a label that depends on several.
        decides.append(
            changes[-1] > 0
            or (
                several
                and any(
                    label([_step_from(env, state, prefix, space.sample())], function)[0] != labels[0]
                    for _ in range(N_JOINT)
                )
            )
        )
    changed = [number for number in changes if number > 0]
    ordered = changed and isinstance(space, spaces.Box)
    return float(np.mean(decides)), float(np.mean(changed)) if ordered else None


def _sweep_actions(space: Any, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """Every discrete action; otherwise N_ACTIONS along one dimension, the others held at random values."""
    if isinstance(space, spaces.Discrete):
        return np.arange(space.n)
    actions = np.repeat(np.asarray(rng.uniform(space.low, space.high))[None], N_ACTIONS, axis=0)
    flat = actions.reshape(N_ACTIONS, -1)
    dimension = rng.integers(flat.shape[1])
    flat[:, dimension] = np.linspace(space.low.flat[dimension], space.high.flat[dimension], N_ACTIONS)
    return actions.astype(space.dtype)


def _step_from(env: gym.Env[Any, Any], seed: int, prefix: list[Any], action: Any) -> Transition:
    """One action in the state to which a reset with this seed and the actions of ``prefix`` lead."""
    obs = _reset(env, seed)
    for earlier in prefix:
        reached, ended, _ = _step(env, earlier)
        if ended:  # the episode is over: the action is tried in its first state instead
            obs = _reset(env, seed)
            break
        obs = reached
    obs = copy_observation(obs)
    next_obs, _, info = _step(env, action)
    return Transition(obs, action, copy_observation(next_obs), info)


def _reset(env: gym.Env[Any, Any], seed: int | None) -> Any:
    answer: Any = env.reset() if seed is None else env.reset(seed=seed)
    if not (isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], dict)):
        raise ValueError(
            f"`env.reset` must return a tuple (obs, info), as Gymnasium has it, but returned {_kind(answer)}: return "
            "`obs, {}`."
        )
    return answer[0]


def _step(env: gym.Env[Any, Any], action: Any) -> tuple[Any, bool, dict[str, Any]]:
    """The observation after a step, whether the episode has ended, and ``info``."""
    answer: Any = env.step(action)
    if not (isinstance(answer, tuple) and len(answer) == 5 and isinstance(answer[4], dict)):
        raise ValueError(
            "`env.step` must return a tuple (obs, reward, terminated, truncated, info), as Gymnasium has it, but "
            f"returned {_kind(answer)}: return separately whether the episode terminated and whether it was truncated."
        )
    obs, _, terminated, truncated, info = answer
    return obs, bool(terminated or truncated), info


def _kind(answer: Any) -> str:
    kinds = ", ".join(type(part).__name__ for part in answer) if isinstance(answer, tuple) else ""
    return f"a tuple of ({kinds})" if kinds else f"one {type(answer).__name__}"
