"""Gymnasium's Taxi: driving to a passenger, picking them up, and taking them where they want to go."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray


def taxi(obs: np.ndarray[Any, Any], actions: np.ndarray[Any, Any], next_obs: np.ndarray[Any, Any]) -> BoolArray:
    """``sap/Taxi-v0`` and ``Taxi-v4``: False where the state did not change.

    *Argument.* It ran into a wall, or there was nobody to pick up or to drop. The same state a step later, at a cost of
    1 or 10, is worth less than now: the label is sound.

    :param obs: (n, 4), or (n,) numbers of states
    :param actions: (n,)
    :param next_obs: the same
    :return: (n,) bool
    """
    return np.asarray((obs != next_obs).reshape(len(actions), -1).any(axis=1))
