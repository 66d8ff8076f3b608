"""The hand-made constraints of the paper's baselines (section 5.1): what steering they allow in a lane-keeping state.

Each is a callable for one environment:

:param obs: the observation, as the environment returns it, shape (5,)
:param previous_obs: the one before, shape (5,)
:param last_action: the action executed between them, shape (1,)
:return: lowest and highest allowed action, each of shape (1,)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Ends of the steering range.
FULL_LEFT, FULL_RIGHT = 1.0, -1.0

Interval = tuple[NDArray[Any], NDArray[Any]]


def constraint_ce1(obs: NDArray[Any], previous_obs: NDArray[Any], last_action: NDArray[Any]) -> Interval:
    """DDPG-CE1: left of the centre line steer no further left than in the last step, right of it no further right."""
    del previous_obs
    track_pos = obs[1]
    low, high = np.full_like(last_action, FULL_RIGHT), np.full_like(last_action, FULL_LEFT)
    if track_pos > 0:
        high = last_action.copy()
    elif track_pos < 0:
        low = last_action.copy()
    return low, high


def constraint_ce2(obs: NDArray[Any], previous_obs: NDArray[Any], last_action: NDArray[Any]) -> Interval:
    """DDPG-CE2: as CE1, but only after an action that took the car further from the centre line."""
    if abs(obs[1]) - abs(previous_obs[1]) > 0:
        return constraint_ce1(obs, previous_obs, last_action)
    return np.full_like(last_action, FULL_RIGHT), np.full_like(last_action, FULL_LEFT)
