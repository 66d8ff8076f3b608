"""highway-env's tasks with a steering wheel: a parking lot, and a racetrack with another car on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_sap.permissibility import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

GOAL_RADIUS = 0.1
"""Distance to the parking place within which a car may have to turn away to get in, in units of 100 m."""
BRAKING = 4.0
"""m/s², a little less than the car can brake with."""

FAR = 20.0
"""m that one unit of the racetrack's observation is."""
NEAR_AHEAD, NEAR_BEHIND = 15.0 / FAR, 6.0 / FAR
"""From where to where another car is in the way; a car is 5 m long."""
CLEARANCE = 4.5 / FAR
"""Less than this to the side is in the same lane: lanes are 5 m wide, a car 2 m."""
LANE_TOLERANCE = 0.1
"""Share of half a lane within which a car may be anywhere."""


def parking(obs: Mapping[str, Array], actions: Array, next_obs: Mapping[str, Array]) -> BoolArray:
    """``parking-v0``: False where, far from its place, the car approached it more slowly than before, though it could
    still stop there.

    *Heuristic.* Steering and pedal are both judged, through the speed at which the distance shrinks: every step costs,
    and nothing is gained by coming later. But a car may have to drive a bend to come in at the right angle; within
    `GOAL_RADIUS`, where that is the rule, nothing is said.

    :param obs: of highway-env's KinematicsGoal with its default scales: "achieved_goal" and "desired_goal" are
        (n, 6): x, y in units of 100 m, vx, vy of 5 m/s, cos and sin of the heading
    :param actions: (n, 2) acceleration, steering
    :param next_obs: the same
    :return: (n,) bool
    """
    del actions
    distance, next_speed = np.linalg.norm(_to_goal(next_obs), axis=1), approach_speed(next_obs)
    can_stop = (5 * next_speed) ** 2 < 2 * BRAKING * 100 * distance
    mistake: BoolArray = (distance > GOAL_RADIUS) & (next_speed < approach_speed(obs)) & can_stop
    return ~mistake


def approach_speed(obs: Mapping[str, Array]) -> FloatArray:
    """Speed towards the goal, in units of 5 m/s, negative away from it; (n,)."""
    towards = _to_goal(obs)
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    speed: FloatArray = (obs["achieved_goal"][:, 2:4] * towards).sum(axis=1) / distance
    return speed


def _to_goal(obs: Mapping[str, Array]) -> FloatArray:
    difference: FloatArray = obs["desired_goal"][:, :2] - obs["achieved_goal"][:, :2]
    return difference


def racetrack(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``racetrack-v0``: False where another car is in the way, and the step turned towards it; or none is, and the step
    took the car away from the middle of its lane.

    *Heuristic.* In the way is who would be passed at less than `CLEARANCE` if one's own course were straight and the
    other stood still; to turn so that this is still less brings the crash nearer. But where the other lane is taken, or
    the road ends, turning away is no better. The other half is the paper's lane keeping.

    :param obs: (n, cars, 9) of highway-env's Kinematics, ranges as in ``zoo_configs``: presence, x, y, vx, vy, cos_h,
        sin_h, lat_off, ang_off; the other cars relative to the first
    :param actions: (n, 1) steering
    :param next_obs: (n, cars, 9)
    :return: (n,) bool
    """
    del actions
    clearance, next_clearance = passing_distance(obs), passing_distance(next_obs)
    in_the_way = np.isfinite(clearance) & (next_clearance < CLEARANCE)
    off, next_off = np.abs(obs[:, 0, 7]), np.abs(next_obs[:, 0, 7])
    leaves_lane = (next_off > off) & (next_off > LANE_TOLERANCE)
    mistake: BoolArray = np.where(in_the_way, next_clearance < clearance, leaves_lane)
    return ~mistake


def passing_distance(obs: Array) -> FloatArray:
    """At what distance to the side a straight course passes the nearest such car, in units of `FAR`; (n,).

    Infinite where no car is between `NEAR_BEHIND` and `NEAR_AHEAD`.
    """
    position, course = obs[:, 1:, 1:3], obs[:, :1, 5:7]  # (n, cars - 1, 2), (n, 1, 2)
    ahead = (position * course).sum(axis=-1)
    aside = np.abs(position[..., 0] * course[..., 1] - position[..., 1] * course[..., 0])
    near = (obs[:, 1:, 0] > 0) & (ahead > -NEAR_BEHIND) & (ahead < NEAR_AHEAD)
    nearest: FloatArray = np.where(near, aside, np.inf).min(axis=1)
    return nearest
