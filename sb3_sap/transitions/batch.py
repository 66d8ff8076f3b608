"""A batch of transitions that somebody else made, and the check of its rows against the spaces of an environment."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, FloatArray, Observations, rows_of
from sb3_sap.common.errors import nearest
from sb3_sap.common.vec_envs import policy_layout

#: By how much of its range an action may lie outside of a ``Box``: what a logger rounds is put on the bound.
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Transitions:
    """n steps in the environment's units: raw observations, actions as they were executed.

    If it has rewards, the rows are in the order in which they happened, one episode after the other.
    """

    obs: Observations  # (n, *obs_shape)
    actions: np.ndarray[Any, Any]  # (n, *action_shape)
    next_obs: Observations  # (n, *obs_shape), the true ones: never those after a reset
    rewards: FloatArray | None = None  # (n,) of the environment
    dones: BoolArray | None = None  # (n,) whether the episode ended, for whatever reason
    truncated: BoolArray | None = None  # (n,) whether it was cut off there, so that the last state is not terminal
    labels: BoolArray | None = None  # (n,) True where the action was permissible; None: the AP function tells

    def __len__(self) -> int:
        return len(self.actions)

    def rows(self, which: Any) -> Transitions:
        """Some of the transitions."""
        return Transitions(**{name: rows_of(array, which) for name, array in self.arrays().items()})

    def arrays(self) -> dict[str, Any]:
        """The arrays that there are, by name."""
        found = {name: getattr(self, name) for name in NAMES}
        return {name: array for name, array in found.items() if array is not None}


@contextmanager
def readable(path: object) -> Iterator[None]:
    """Turns any error of a library that reads a file into a ``ValueError`` of one sentence."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path} cannot be read, {type(error).__name__}: {reason}") from error


NAMES = tuple(field.name for field in fields(Transitions))


def transitions_of(arrays: Mapping[str, Any]) -> Transitions:
    """Transitions of arrays by name.

    :raise ValueError: if one is missing, unknown, or not as long as the others
    """
    for name in arrays.keys() - set(NAMES):
        raise ValueError(f"Transitions have no array {name!r}: {nearest(name, NAMES)}")
    for name in ("obs", "actions", "next_obs"):
        if arrays.get(name) is None:
            raise ValueError(f"Transitions need an array {name!r}: give `obs`, `actions` and `next_obs` at least.")
    given: dict[str, Any] = {
        name: {key: np.asarray(one) for key, one in value.items()} if isinstance(value, Mapping) else np.asarray(value)
        for name, value in arrays.items()
        if value is not None
    }
    n = len(given["actions"])
    for name, value in given.items():
        for array in value.values() if isinstance(value, dict) else [value]:
            if array.ndim == 0 or len(array) != n:
                raise ValueError(f"`{name}` has the shape {array.shape}, but there are {n} actions: one row for each.")
    for name in ("rewards", "dones", "truncated", "labels"):
        of_parts = name == "labels" and name in given and given[name].ndim == 2  # one for each part of the action
        if name in given and given[name].size != n and not of_parts:
            raise ValueError(
                f"`{name}` has the shape {given[name].shape}, but must have one value for each of {n} rows."
            )
    for name in ("dones", "truncated", "labels"):
        if name in given:
            given[name] = as_bool(name, given[name])
    if "truncated" in given:  # what was cut off has ended
        given["dones"] = given["truncated"] | given.get("dones", np.zeros(n, dtype=bool))
    if "rewards" in given:
        given["rewards"] = np.asarray(given["rewards"], dtype=np.float32).reshape(n)
    return Transitions(**given)


def fitting(
    batch: Transitions, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> tuple[Transitions, BoolArray, Counter[str]]:
    """A batch as a model of these spaces takes it, and which of its rows are of use.

    :return: the batch, with images as the policy sees them and actions within their bounds; (n,) which rows are
        sound; and how many were refused for which reason
    :raise ValueError: if the shapes or types are not those of the spaces
    """
    n = len(batch)
    # Before they are turned into whole numbers, which cannot be NaN.
    finite = _finite(batch.obs, n) & _finite(batch.next_obs, n) & _finite(batch.actions, n)
    obs, next_obs = (
        _fitted(name, policy_layout(value, observation_space), observation_space, n)
        for name, value in (("obs", batch.obs), ("next_obs", batch.next_obs))
    )
    actions, inside = _fitted_actions(batch.actions, action_space, n)
    known = _within(obs, observation_space, n) & _within(next_obs, observation_space, n)
    if batch.rewards is not None:
        finite &= np.isfinite(batch.rewards)
    refused = Counter(
        {
            "not finite": int((~finite).sum()),
            "action out of bounds": int((finite & ~inside).sum()),
            "observation that the space does not have": int((finite & inside & ~known).sum()),
        }
    )
    return replace(batch, obs=obs, next_obs=next_obs, actions=actions), finite & inside & known, refused


def _fitted(name: str, values: Any, space: spaces.Space[Any], n: int) -> Any:
    """(n, *shape) values in the space's dtype."""
    if isinstance(space, spaces.Dict):
        if not isinstance(values, dict) or set(values) != set(space.spaces):
            got = f"the keys {', '.join(sorted(values))}" if isinstance(values, dict) else "one array"
            raise ValueError(f"`{name}` must have an array for each of {', '.join(space.spaces)}, but has {got}.")
        return {key: _fitted(f"{name}[{key!r}]", values[key], one, n) for key, one in space.spaces.items()}
    shape, dtype = (n, *(space.shape or ())), np.dtype(space.dtype)
    # A single number may be (n,) or (n, 1).
    if isinstance(values, dict) or _longer_than_one(values.shape) != _longer_than_one(shape):
        got = "several arrays" if isinstance(values, dict) else f"the shape {values.shape}"
        raise ValueError(f"`{name}` has {got}, but for {n} rows of {space} it must be {shape}.")
    values = values.reshape(shape)
    if values.dtype.kind == "f":
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)  # such rows are refused
    if np.issubdtype(dtype, np.integer) and not _whole(values, dtype):
        raise ValueError(
            f"`{name}` has values of type {values.dtype} that are no whole numbers of {space}: give them in the "
            "environment's own units, neither normalised nor scaled."
        )
    return values.astype(dtype, copy=False)


def _longer_than_one(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (shape[0], *(length for length in shape[1:] if length != 1)) if shape else ()


def _whole(values: np.ndarray[Any, Any], dtype: Any) -> bool:
    """Whether values can be of an integer type."""
    limits = np.iinfo(dtype)
    return bool(np.all(values == np.rint(values)) and np.all((values >= limits.min) & (values <= limits.max)))


def _fitted_actions(
    actions: np.ndarray[Any, Any], space: spaces.Space[Any], n: int
) -> tuple[np.ndarray[Any, Any], BoolArray]:
    """(n, *action_shape) actions, those a little out of bounds put on them, and (n,) which are inside."""
    actions = _fitted("actions", actions, space, n)
    if not isinstance(space, spaces.Box):
        return actions, _within(actions, space, n)
    flat, low, high = _flat(actions, n), space.low.reshape(-1), space.high.reshape(-1)
    slack = TOLERANCE * (high - low)
    inside = np.all((flat >= low - slack) & (flat <= high + slack), axis=1)
    return np.clip(actions, space.low, space.high), inside


def _within(values: Any, space: spaces.Space[Any], n: int) -> BoolArray:
    """(n,) which rows a finite space has; those of a ``Box`` count as it has them."""
    if isinstance(space, spaces.Dict):
        parts = [_within(values[key], one, n) for key, one in space.spaces.items()]
        return np.asarray(np.all(parts, axis=0))
    if isinstance(space, spaces.Box):
        return np.ones(n, dtype=bool)
    flat = _flat(values, n)
    if isinstance(space, spaces.Discrete):
        low, high = np.array([int(space.start)]), np.array([int(space.start) + int(space.n) - 1])
    elif isinstance(space, spaces.MultiDiscrete):
        low, high = space.start.reshape(-1), (space.start + space.nvec).reshape(-1) - 1
    else:
        low, high = np.zeros(1), np.ones(1)
    return np.asarray(np.all((flat >= low) & (flat <= high), axis=1))


def _flat(values: np.ndarray[Any, Any], n: int) -> np.ndarray[Any, Any]:
    """(n, k), also of no rows."""
    return values.reshape(n, math.prod(values.shape[1:]))


def _finite(values: Any, n: int) -> BoolArray:
    """(n,) whether all numbers of a row are finite."""
    arrays = values.values() if isinstance(values, dict) else [values]
    found = np.ones(n, dtype=bool)
    for array in arrays:
        if array.dtype.kind == "f":
            found &= np.isfinite(_flat(array, n)).all(axis=1)
    return found


def as_bool(name: str, values: np.ndarray[Any, Any]) -> BoolArray:
    """(n,) bool, or (n, k) if there are several columns, of bool or of 0 and 1.

    :raise ValueError: for anything else
    """
    if values.size == len(values):
        values = values.reshape(len(values))
    if values.dtype != np.bool_ and not (values.dtype.kind in "iuf" and np.isin(values, (0, 1)).all()):
        raise ValueError(f"`{name}` must be True or False (or 1 or 0) in each row, but has values of {values.dtype}.")
    return values.astype(bool)
