"""Arrays and observations, which are arrays or, for a ``Dict`` space, one array per key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

#: A batch of observations, (n, *obs_shape), or one such array per key of a ``Dict`` space.
Observations: TypeAlias = "np.ndarray[Any, Any] | dict[str, np.ndarray[Any, Any]]"
BoolArray: TypeAlias = "np.ndarray[Any, np.dtype[np.bool_]]"
FloatArray: TypeAlias = "np.ndarray[Any, np.dtype[np.floating[Any]]]"


def copy_observation(obs: Any) -> Any:
    """A copy of an observation or a batch: environments may reuse their arrays, and user functions may modify them."""
    return {key: np.copy(value) for key, value in obs.items()} if isinstance(obs, Mapping) else np.copy(obs)


def same_observation(one: Any, other: Any) -> bool:
    """Whether two observations, or batches of them, are equal."""
    if isinstance(one, Mapping):
        return all(np.array_equal(one[key], other[key]) for key in one)
    return np.array_equal(one, other)


def rows_of(obs: Any, rows: Any) -> Any:
    """The given rows of a batch of observations; for an integer, a single observation."""
    return {key: value[rows] for key, value in obs.items()} if isinstance(obs, dict) else obs[rows]


def joined_rows(parts: list[Any]) -> Any:
    """Several batches of observations in one; for a ``Dict`` space, one array per key."""
    if isinstance(parts[0], dict):
        return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return np.concatenate(parts)


def stack_observations(observations: list[Any]) -> Any:
    """A batch of single observations; for a ``Dict`` space, one array per key."""
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)
