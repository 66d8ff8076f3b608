"""A_st, the candidates that may replace a rejected action, and the choice among them (Alg. 1, lines 8 to 11)."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, FloatArray

#: How the action to execute is chosen among the permissible candidates; "random" is the paper's.
SELECTIONS = ("random", "nearest", "highest_q", "most_permissible")


def candidate_actions(
    rng: np.random.Generator, space: spaces.Space[Any], low: FloatArray, high: FloatArray, n: int
) -> np.ndarray[Any, Any]:
    """A_st for m states: n stratified draws from a continuous space, or every discrete action.

    :param low: (m, action_dim) lower bounds, scaled; ignored for discrete actions
    :param high: (m, action_dim) upper bounds
    :return: (m, n, action_dim)
    """
    if isinstance(space, spaces.Discrete):
        return np.tile(np.arange(space.n)[:, None], (len(low), 1, 1))
    return stratified_candidates(rng, low, high, n)


def stratified_candidates(rng: np.random.Generator, low: FloatArray, high: FloatArray, n: int) -> FloatArray:
    """Low-variance uniform sampling (section 4.3): one draw from each of n equal strata of every dimension.

    In one dimension the candidates are in ascending order; in more, the strata of the dimensions are paired at
    random, which is Latin hypercube sampling.

    :param low: (m, action_dim) lower bounds
    :param high: (m, action_dim) upper bounds
    :return: (m, n, action_dim) candidates, float32
    """
    m, dim = low.shape
    strata = np.broadcast_to(np.arange(n)[:, None], (m, n, dim))
    if dim > 1:
        strata = rng.permuted(strata, axis=1)
    unit = (strata + rng.random((m, n, dim))) / n  # (m, n, action_dim) in [0, 1)
    return (low[:, None] + unit * (high - low)[:, None]).astype(np.float32)


def only_in(
    actions: np.ndarray[Any, Any], dimensions: tuple[int, ...], candidates: np.ndarray[Any, Any]
) -> np.ndarray[Any, Any]:
    """(m, n, action_dim) candidates for m actions, which they equal but in some dimensions."""
    kept = np.ones(actions.shape[1], dtype=bool)
    kept[list(dimensions)] = False
    return np.where(kept, actions[:, None], candidates)


def choose(
    rng: np.random.Generator, candidates: np.ndarray[Any, Any], permissible: BoolArray, scores: FloatArray | None
) -> np.ndarray[Any, Any]:
    """One permissible candidate for each of m states.

    :param candidates: (m, n, action_dim)
    :param permissible: (m, n), each row with at least one True
    :param scores: (m, n), of which the highest is chosen; ``None``: a candidate is drawn at random
    :return: (m, action_dim)
    """
    if scores is None:
        return np.stack([rng.choice(row[allowed]) for row, allowed in zip(candidates, permissible, strict=True)])
    best = np.where(permissible, scores, -np.inf).argmax(axis=1)
    return np.asarray(candidates[np.arange(len(candidates)), best])
