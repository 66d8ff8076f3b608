"""highway-env's tasks with a steering wheel: a parking lot, and a highway with other cars on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

#: Distance to the parking place within which a car may have to turn away from it to get in, in units of 100 m.
GOAL_RADIUS = 0.1
#: Deceleration a little below what the car can brake with, m/s².
BRAKING = 4.0

#: Units of x, y, vx and vy in the highway's observation: m, m, m/s and m/s.
SCALES = np.array([100.0, 12.0, 20.0, 20.0], dtype=np.float32)
#: Distances between the middles of two cars, along and across the road, below which they may touch, m (a car is 5 by
#: 2 m).
CAR_LENGTH, CLEARANCE = 6.0, 3.0
#: Times ahead at which the positions of all cars are compared, s.
AHEAD = np.linspace(0, 3, 13, dtype=np.float32)
#: Lateral positions of the edges of the road with three lanes, m.
LEFT_EDGE, RIGHT_EDGE = -2.0, 10.0
#: Time to the edge at the present lateral speed, below which moving faster towards it is a mistake, s.
EDGE_TIME = 1.0


def parking(obs: Mapping[str, Array], actions: Array, next_obs: Mapping[str, Array]) -> BoolArray:
    """``parking-v0``: False where, far from its place, the car approached it more slowly than before, though it could
    still stop there.

    *Heuristic.* Steering and pedal are both judged, through the speed at which the distance shrinks: every step costs,
    and nothing is gained by coming later. But a car may have to drive a bend to come in at the right angle; within
    `GOAL_RADIUS`, where that is common, no action is labelled False; nor is one of a car that is too fast to stop.

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


def highway(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``highway-fast-v0`` with a steering wheel: False where the car is going to hit another, and the step brought them
    still nearer; or where it is about to leave the road, and the step made it faster towards the edge.

    *Heuristic.* On straight courses at their present speeds two cars pass at some lateral distance, or collide: to
    reduce that distance only leads to the crash. But a third car may leave no other way.

    :param obs: (n, cars, 5) of highway-env's Kinematics, features and ranges as in ``zoo_configs``: presence, x, y, vx,
        vy; the other cars relative to the first, whose y counts from the leftmost lane
    :param actions: (n, 1) steering
    :param next_obs: (n, cars, 5)
    :return: (n,) bool
    """
    del actions
    miss, next_miss = passing_distance(obs), passing_distance(next_obs)
    next_y, next_speed = next_obs[:, 0, 2] * SCALES[1], next_obs[:, 0, 4] * SCALES[3]
    room = np.where(next_speed > 0, RIGHT_EDGE - next_y, next_y - LEFT_EDGE)
    faster_outward = np.abs(next_speed) > obs[:, 0, 4] * SCALES[3] * np.sign(next_speed)
    runs_off = (room < np.abs(next_speed) * EDGE_TIME) & faster_outward
    mistake: BoolArray = runs_off | ((next_miss < CLEARANCE) & (next_miss < miss) & np.isfinite(miss))
    return ~mistake


def passing_distance(obs: Array) -> FloatArray:
    """Lateral distance at which the nearest car will be passed on straight courses, within `AHEAD`; (n,) m.

    Infinite where nobody is passed.
    """
    x, y, vx, vy = np.moveaxis((obs[:, 1:, 1:5] * SCALES)[..., None], -2, 0)  # each (n, cars - 1, 1)
    beside = np.abs(x + vx * AHEAD) < CAR_LENGTH  # (n, cars - 1, times)
    present = obs[:, 1:, :1] > 0
    nearest: FloatArray = np.where(present & beside, np.abs(y + vy * AHEAD), np.inf).min(axis=(1, 2))
    return nearest
