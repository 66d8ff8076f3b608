"""highway-env's tasks with a steering wheel: a parking lot, and a racetrack with another car on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_sap.permissibility import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

GOAL_RADIUS = 0.1
"""Distance to the parking place within which a car may have to turn away to get in, in units of 100 m."""

FAR = 40.0
"""m, and m/s, that one unit of the racetrack's observation is."""
MISS_DISTANCE = 3.5 / FAR
"""Less than this between two centres is called a collision: a car is 5 m long and 2 m wide, lanes are 5 m apart."""
HORIZON = 3.0
"""s ahead that a collision course is looked for."""
LANE_TOLERANCE = 0.1
"""Share of half a lane within which a car may be anywhere."""


def parking(obs: Mapping[str, Array], actions: Array, next_obs: Mapping[str, Array]) -> BoolArray:
    """``parking-v0``: False where, far from its place, the car drove away from it and faster so than before.

    *Heuristic.* Steering and pedal are both judged, through the speed at which the distance shrinks. A car may have to
    drive off to come in at the right angle; within `GOAL_RADIUS`, where that is the rule, nothing is said.

    :param obs: of highway-env's KinematicsGoal with its default scales: "achieved_goal" and "desired_goal" are
        (n, 6): x, y in units of 100 m, vx, vy of 5 m/s, cos and sin of the heading
    :param actions: (n, 2) acceleration, steering
    :param next_obs: the same
    :return: (n,) bool
    """
    del actions
    away, next_away = leaving_speed(obs), leaving_speed(next_obs)
    far = np.linalg.norm(_to_goal(next_obs), axis=1) > GOAL_RADIUS
    mistake: BoolArray = far & (next_away > 0) & (next_away > away)
    return ~mistake


def leaving_speed(obs: Mapping[str, Array]) -> FloatArray:
    """Speed away from the goal, in units of 5 m/s; (n,)."""
    towards = _to_goal(obs)
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    speed: FloatArray = -(obs["achieved_goal"][:, 2:4] * towards).sum(axis=1) / distance
    return speed


def _to_goal(obs: Mapping[str, Array]) -> FloatArray:
    difference: FloatArray = obs["desired_goal"][:, :2] - obs["achieved_goal"][:, :2]
    return difference


def racetrack(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``racetrack-v0``: False where the car is on a collision course, and the step made the miss still smaller; or is
    not on one, and the step took it away from the middle of its lane.

    *Heuristic.* On straight courses at their present speeds, two cars will pass at some least distance; to make it
    smaller, if it is less than `MISS_DISTANCE`, within `HORIZON`, brings the crash nearer. On a bend courses are not
    straight. The other half is the paper's lane keeping.

    :param obs: (n, cars, 9) of highway-env's Kinematics, ranges as in ``zoo_configs``: presence, x, y, vx, vy, cos_h,
        sin_h, lat_off, ang_off; the other cars relative to the first
    :param actions: (n, 1) steering
    :param next_obs: (n, cars, 9)
    :return: (n,) bool
    """
    del actions
    miss, next_miss = least_distance(obs), least_distance(next_obs)
    collision_course = next_miss < MISS_DISTANCE
    off, next_off = np.abs(obs[:, 0, 7]), np.abs(next_obs[:, 0, 7])
    leaves_lane = (next_off > off) & (next_off > LANE_TOLERANCE)
    mistake: BoolArray = np.where(collision_course, next_miss < miss, leaves_lane)
    return ~mistake


def least_distance(obs: Array) -> FloatArray:
    """The least distance to any other car within `HORIZON` on straight courses, in units of `FAR`; (n,)."""
    others = obs[:, 1:]  # (n, cars - 1, 9)
    position, velocity = others[..., 1:3], others[..., 3:5]
    speed_squared = np.maximum((velocity**2).sum(axis=-1), 1e-12)
    when = np.clip(-(position * velocity).sum(axis=-1) / speed_squared, 0, HORIZON)  # (n, cars - 1), s
    distance = np.linalg.norm(position + velocity * when[..., None], axis=-1)
    nearest: FloatArray = np.where(others[..., 0] > 0, distance, np.inf).min(axis=1)
    return nearest
