"""highway-env's racetrack: steering along the lanes of a winding circuit, at constant speed."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

#: Features of the Kinematics observation that the entries in ``zoo_configs`` ask for, in this order.
FEATURES = ("presence", "x", "y", "cos_h", "sin_h", "lat_off", "ang_off")
#: Unit of x and y, m. The lateral offset from the middle of the lane is in m, the angle between car and lane in rad.
PLACE_SCALE = 100.0
#: Distance ahead at which the course is judged, m: half a second at 10 m/s.
AHEAD = 5.0
#: Offset of the course from the middle of the lane that is no mistake, m; a lane is 5 m wide.
TOLERANCE = 0.5
#: Distance of another car within which no action is called a mistake, m.
NEAR_CAR = 25.0


def racetrack(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``racetrack-v0``: False where the step turned the car away from the middle of its lane, while its course lies
    more than `TOLERANCE` beside it and no other car is within `NEAR_CAR`.

    The course is the lateral offset from the middle of the nearest lane, `AHEAD` metres on with the present angle
    between car and lane. The steering decides it at once, while the offset itself follows a step later.

    *Heuristic*, nearly sound on an empty track. The reward of a step falls with the offset alone, apart from the
    steering angle, and nothing is to be gained beside the middle of a lane: a course that leads farther out only has to
    be taken back. Changing lanes is the exception. It pays where another car is in the way, which is why nothing is
    judged near one; from 2.5 m on the next lane is the nearest, and the label is about that one.

    :param obs: (n, cars, 7) of highway-env's Kinematics, with `FEATURES` and the ranges of ``zoo_configs``; the car
        itself comes first, and the places of the others are relative to it
    :param actions: (n, 1) steering
    :param next_obs: (n, cars, 7)
    :return: (n,) bool
    """
    del actions
    off, next_off = np.abs(course(obs)), np.abs(course(next_obs))
    mistake: BoolArray = (next_off > off) & (next_off > TOLERANCE) & ~(car_near(obs) | car_near(next_obs))
    return ~mistake


def course(obs: Array) -> FloatArray:
    """Offset from the middle of the nearest lane, `AHEAD` metres on, positive to the right; (n,) m."""
    offset: FloatArray = obs[:, 0, 5] + AHEAD * np.sin(obs[:, 0, 6])
    return offset


def car_near(obs: Array) -> BoolArray:
    """Whether another car is within `NEAR_CAR`; (n,)."""
    distance = np.linalg.norm(obs[:, 1:, 1:3] * PLACE_SCALE, axis=2)
    near: BoolArray = ((obs[:, 1:, 0] > 0) & (distance < NEAR_CAR)).any(axis=1)
    return near
