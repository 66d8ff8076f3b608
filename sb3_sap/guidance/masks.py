"""Type-2 permissibility: actions that the state alone rules out, before they are executed."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, Observations, rows_of
from sb3_sap.common.functions import resolve
from sb3_sap.common.spaces import joint_actions, sizes_of
from sb3_sap.permissibility import query_labels


class PermissibleActions(Protocol):
    """Which actions of a batch may be executed, as a function of the state alone.

    :param obs: raw (never normalised) observations, (n, *obs_shape)
    :param actions: in the units of the environment's action space, (n, *action_shape)
    :return: (n,) bool
    """

    def __call__(self, obs: Observations, actions: np.ndarray[Any, Any], /) -> BoolArray: ...


class ObservedMask:
    """The permissible actions that an entry of a ``Dict`` observation lists.

    The entry has one value, 0 or 1, for each action of a ``Discrete`` space. For ``MultiDiscrete`` and ``MultiBinary``
    it has one for each choice of each dimension, one dimension after the other, as sb3-contrib's ``MaskablePPO`` has
    it, or one for each combination, of the shape (n_1, n_2, …).

    :param key: of the entry
    :param observation_space: of the environment
    :param action_space: a finite one
    :raise ValueError: if the entry does not fit the actions
    """

    def __init__(self, key: str, observation_space: spaces.Dict, action_space: spaces.Space[Any]):
        self.key = key
        self.sizes = sizes_of(action_space)
        shape = observation_space[key].shape
        self.joint = len(self.sizes) > 1 and shape == tuple(self.sizes)
        if not self.joint and shape != (sum(self.sizes),):
            combinations = f", or {tuple(self.sizes)}, one for each combination" if len(self.sizes) > 1 else ""
            raise ValueError(
                f"`permissible_actions` names the entry {key!r} of the observation, whose shape is {shape}, but a mask "
                f"of {action_space} has the shape ({sum(self.sizes)},), one value for each choice{combinations}."
            )

    def masks(self, obs: Any) -> BoolArray:
        """(n, k) bool, which of all k actions n observations list as permissible."""
        if not self.joint:
            return joint_masks(self.choices(obs), self.sizes)
        entry = self._entry(obs)
        return entry.reshape(len(entry), -1)

    def choices(self, obs: Any) -> BoolArray:
        """(n, sum of sizes) bool, for each choice of each dimension. Where none of a dimension is listed, all are."""
        columns = np.split(self._entry(obs), np.cumsum(self.sizes)[:-1], axis=1)
        return np.concatenate([column | ~column.any(axis=1, keepdims=True) for column in columns], axis=1)

    def _entry(self, obs: Any) -> BoolArray:
        return np.asarray(np.asarray(obs[self.key]) > 0.5)  # 0 and 1 may have been normalised and recovered

    def __call__(self, obs: Any, actions: np.ndarray[Any, Any]) -> BoolArray:
        chosen = np.asarray(actions).reshape(len(actions), len(self.sizes)).astype(int)
        rows = np.arange(len(chosen))
        if self.joint:
            return np.asarray(self.masks(obs)[rows, np.ravel_multi_index(tuple(chosen.T), self.sizes)])
        starts = np.cumsum(self.sizes) - self.sizes
        return np.asarray(self.choices(obs)[rows[:, None], chosen + starts].all(axis=1))


def mask_source(
    permissible_actions: PermissibleActions | str | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
) -> PermissibleActions | None:
    """What ``permissible_actions`` stands for: a function, its dotted name, or the key of a ``Dict`` observation.

    :raise ValueError: if the entry of that key is no mask of these actions
    """
    if not isinstance(permissible_actions, str):
        return None if permissible_actions is None else resolve(permissible_actions, "permissible_actions")
    if not isinstance(observation_space, spaces.Dict) or permissible_actions not in observation_space.spaces:
        if "." not in permissible_actions:
            raise ValueError(
                f"`permissible_actions` = {permissible_actions!r} is neither the dotted name of a function nor a key "
                f"of the observation space {observation_space}: wrap an environment with `action_masks()` in "
                "`ActionMaskObservation`, or give the function itself."
            )
        return resolve(permissible_actions, "permissible_actions")
    if isinstance(action_space, spaces.Box):
        raise ValueError(
            f"`permissible_actions` = {permissible_actions!r} names an entry of the observation, which can list "
            f"finitely many actions, but the action space is {action_space}: give a function (obs, actions) -> bool."
        )
    return ObservedMask(permissible_actions, observation_space, action_space)


def joint_masks(choices: BoolArray, sizes: list[int]) -> BoolArray:
    """(n, k) masks of all combinations, the last dimension fastest, from masks of each dimension, (n, sum of sizes)."""
    first, *others = np.split(choices, np.cumsum(sizes)[:-1], axis=1)
    for column in others:
        first = (first[:, :, None] & column[:, None, :]).reshape(len(first), -1)
    return first


def known_masks_of(source: PermissibleActions, action_space: spaces.Space[Any], obs: Any) -> BoolArray:
    """Masks in the form that their source has: of each choice of each dimension, or as :func:`masks_of` gives them.

    :param obs: n raw observations
    """
    if isinstance(source, ObservedMask) and not source.joint:
        return source.choices(obs)
    return masks_of(source, action_space, obs)


def masks_of(source: PermissibleActions, action_space: spaces.Space[Any], obs: Any) -> BoolArray:
    """(n, k) bool, which of all k actions of a finite space may be executed in n states; where none may, all.

    :param obs: n raw observations
    """
    if isinstance(source, ObservedMask):
        mask = source.masks(obs)
    else:
        actions = joint_actions(action_space)
        n, k = len(next(iter(obs.values())) if isinstance(obs, dict) else obs), len(actions)
        # A copy of the actions for each state: the function gets a batch of pairs.
        pairs = rows_of(obs, np.repeat(np.arange(n), k)), np.concatenate([actions] * n)
        mask = query_labels(source, "permissible_actions", *pairs).reshape(n, k)
    return np.asarray(mask | ~mask.any(axis=1, keepdims=True))


def masks_at(model: Any, source: PermissibleActions, observation: Any) -> BoolArray:
    """What :func:`known_masks_of` gives for one observation or a batch, as ``predict`` takes it."""
    check_statistics(model, source)
    return known_masks_of(source, model.action_space, model.raw_observations(observation))


def check_statistics(model: Any, source: PermissibleActions | None) -> None:
    """Checks that a function of raw observations can be given some.

    :raise ValueError: if a model takes normalised observations and has no statistics to undo that
    """
    if source is None or isinstance(source, ObservedMask):
        return
    if getattr(model, "learned_normalised", False) and model.get_vec_normalize_env() is None:
        raise ValueError(
            "`permissible_actions` judges observations as the environment gives them, but this model takes normalised "
            "ones and has no statistics to undo that: load it with its VecNormalize, `load(path, env=...)`."
        )
