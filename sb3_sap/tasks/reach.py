"""gymnasium-robotics' FetchReach: a hand moves to a goal, with a sparse reward."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

Observation = Mapping[str, np.ndarray[Any, Any]]

#: Distance from the goal within which the environment counts success, m.
NEAR = 0.05
#: The same along one axis: within it on all three, the hand is within `NEAR`.
NEAR_AXIS = NEAR / 3**0.5
#: The parts of the action of `fetch_reach_axes`.
AXES = {"x": [0], "y": [1], "z": [2]}


def fetch_reach(obs: Observation, actions: np.ndarray[Any, Any], next_obs: Observation) -> BoolArray:
    """``FetchReach-v4``: False where the hand came no nearer to its goal, while it is not within `NEAR` of it.

    *Argument.* Every step outside costs 1 and nothing stands in the way, so that the straight way is the shortest. The
    fourth action, the gripper, moves nothing: no label depends on it. A hand has inertia, and goes on for a step in the
    direction of the last one: such a step is labelled by where it went, not by what was asked.

    :param obs: "achieved_goal" and "desired_goal" are (n, 3) positions, m
    :param actions: (n, 4) displacement in x, y, z, and the gripper
    :param next_obs: the same
    :return: (n,) bool
    """
    del actions
    return (distance(next_obs) < distance(obs)) | (distance(next_obs) < NEAR)


def nearness(obs: Observation) -> FloatArray:
    """A potential of ``FetchReach-v4``: minus the distance from the goal in units of `NEAR`; (n,)."""
    return -distance(obs) / NEAR


def distance(obs: Observation) -> FloatArray:
    """From the hand to its goal; (n,) m."""
    gap: FloatArray = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"], axis=1)
    return gap


def fetch_reach_axes(obs: Observation, actions: np.ndarray[Any, Any], next_obs: Observation) -> BoolArray:
    """``FetchReach-v4``, a label for each axis: False where the hand came no nearer to its goal along that axis, while
    it is more than `NEAR_AXIS` from it there.

    *Argument.* That of :func:`fetch_reach`, for each of three movements that do not depend on each other.

    :param obs: as for :func:`fetch_reach`; so are ``actions`` and ``next_obs``
    :return: (n, 3) bool, for `AXES`
    """
    del actions
    gap, next_gap = (np.abs(o["achieved_goal"] - o["desired_goal"]) for o in (obs, next_obs))
    permissible: BoolArray = (next_gap < gap) | (next_gap < NEAR_AXIS)
    return permissible
