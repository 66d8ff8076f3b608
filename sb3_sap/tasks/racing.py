"""TORCS' race against the clock: steering and pedal are judged by themselves.

Accelerations are those of the default car, which brakes with 25 m/s² at 60 km/h and with 39 at 160, and corners with up
to 30 from 80 km/h (``measurements/car_limits.py``).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

#: Parts of the action that `racing` judges, and their dimensions: ``action_parts`` of the algorithms.
RACING_PARTS = {"steering": [0], "pedal": [1]}

#: Entries of the observation, and their units: half widths, m, m/s.
ANGLE, TRACK, TRACK_POS, SPEED_X, SPEED_Y = 0, slice(1, 20), 20, 21, 22
RANGE, SPEED = 200.0, 100 / 3.6
#: Directions of the range finders, rad, positive to the left.
DIRECTIONS = np.radians(np.arange(90.0, -91.0, -10.0))

#: Time to the edge at the present lateral speed, below which moving faster towards it is a mistake, s.
EDGE_TIME = 1.0
#: Steering towards the middle that counts as an attempt to turn back.
INWARD = 0.5
#: Direction of the longest free view beyond which the road bends, rad; steering that counts as turning away from it.
BEND, AWAY = np.radians(25), 0.1
#: Steering that turns the car, and the angle to the road by which it must not swing past it, rad.
TURNING, OVERSHOOT = 0.2, 0.1
#: Lateral speed of the car itself above which it slides, so that steering against the bend catches it, m/s.
SLIDING = 1.0
#: Decelerations, m/s²: half of the car's best, because in a bend its tyres have to steer as well; what it does on any
#: road and in any bend; and less than that.
HARD, SURE, EASY = 12.0, 6.0, 4.0
#: Pedal below which the car brakes.
BRAKE = -0.1
#: |angle| (rad) and |trackPos| below which a car is well placed.
PLACED_ANGLE, PLACED_TRACK_POS = 0.35, 0.8
#: Speed below which it must go on however it is placed, and the speed across the road at which it does not hold a bend,
#: m/s.
CRAWL, CARRIED = 5.0, 1.0


def racing(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``sap/TorcsRacing-v0``: a label of the steering, and one of the pedal.

    Each blames a part for what it did and for what came of it, so that one is never blamed for the other.

    The steering is a mistake in three cases.

    1. *Running wide*: at its lateral speed the car reaches the edge within a second, the step made that speed larger,
       and the wheel was not turned at least half way inward. What leaves the road ends the episode.
    2. *Turning in against the bend*: the free view lies to one side, the wheel was turned to the other, the car does
       not slide, and the view then lay still further aside. The road does not go there.
    3. *Swinging past the road*: the wheel was turned to bring the car's heading back to that of the road, and at the
       rate of this step the car will point past it, by more than `OVERSHOOT`. A car that weaves slides off at speed.

    The pedal is a mistake in four cases, with d the longest free view.

    4. *Too fast for what is in sight*: v² > 2·`HARD`·d, so that stopping within its view takes hard braking, and it did
       not brake.
    5. *Throttle where the bend carries it out*: the free view still lies to one side, the car moves to the other, and
       the throttle was used.
    6. *Dawdling*: the car is well placed or crawls, no bend carries it out, and v² < 2·`EASY`·d, so that gentle braking
       would do, but the throttle was not used, and the car got no faster. This makes standing still a mistake.
    7. *Braking on an open road*: the car is well placed and v² < 2·`SURE`·d, but it was braked. There is time later.

    *Heuristic.* In a wide, constant bend the view is shorter than what the tyres hold, and 4 demands to brake there: a
    driver who knows the road is faster. A late apex may want 1 to be broken for a moment.

    :param obs: (n, 30) as the environment returns them
    :param actions: (n, 2) steering, pedal
    :param next_obs: (n, 30)
    :return: (n, 2) bool, in the order of `RACING_PARTS`
    """
    steering, pedal = actions[:, 0], actions[:, 1]
    return np.stack([steers_well(obs, steering, next_obs), drives_well(obs, pedal, next_obs)], axis=1)


def racing_whole(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``sap/TorcsRacing-v0``: one label of the whole action, permissible where both of `racing` are; (n,) bool."""
    permissible: BoolArray = np.all(racing(obs, actions, next_obs), axis=1)
    return permissible


def steers_well(obs: Array, steering: Array, next_obs: Array) -> BoolArray:
    """Whether the steering, (n,), is permissible; see `racing`."""
    side = np.sign(next_obs[:, TRACK_POS])
    outward = lateral_speed(next_obs) * side
    room = np.where(side > 0, next_obs[:, TRACK][:, 0], next_obs[:, TRACK][:, -1]) * RANGE * np.cos(next_obs[:, ANGLE])
    faster_outward = outward > lateral_speed(obs) * side
    runs_wide = (outward > 0) & (room < outward * EDGE_TIME) & faster_outward & (-steering * side < INWARD)
    view, next_view = free_view(obs)[1], free_view(next_obs)[1]
    bend = np.sign(view)
    slides = np.abs(obs[:, SPEED_Y]) * SPEED > SLIDING
    turns_away = (np.abs(view) > BEND) & (steering * bend < -AWAY) & ~slides & (next_view * bend > np.abs(view))
    angle, next_angle = obs[:, ANGLE], next_obs[:, ANGLE]
    later = 2 * next_angle - angle  # at the rate of this step
    overshoots = (steering * np.sign(angle) > TURNING) & (later * angle < 0) & (np.abs(later) > OVERSHOOT)
    permissible: BoolArray = ~(runs_wide | turns_away | overshoots)
    return permissible


def drives_well(obs: Array, pedal: Array, next_obs: Array) -> BoolArray:
    """Whether the pedal, (n,), is permissible; see `racing`."""
    speed, next_speed = obs[:, SPEED_X] * SPEED, next_obs[:, SPEED_X] * SPEED
    sight, view = free_view(obs)
    needed = np.maximum(speed, 0) ** 2 / (2 * np.maximum(sight, 1e-6))  # m/s², to stop within the view
    well_placed = (np.abs(obs[:, ANGLE]) < PLACED_ANGLE) & (np.abs(obs[:, TRACK_POS]) < PLACED_TRACK_POS)
    too_fast = (needed > HARD) & (pedal > BRAKE)
    drifts = (np.abs(view) > BEND) & (-lateral_speed(obs) * np.sign(view) > CARRIED)
    carried_out = drifts & (pedal > 0)
    dawdles = (well_placed | (speed < CRAWL)) & ~drifts & (needed < EASY) & (pedal <= 0) & (next_speed <= speed)
    brakes = well_placed & (needed < SURE) & (pedal < 0)
    permissible: BoolArray = ~(too_fast | carried_out | dawdles | brakes)
    return permissible


def lateral_speed(obs: Array) -> FloatArray:
    """Speed across the road, (n,) m/s, positive to the left."""
    angle = obs[:, ANGLE]
    across: FloatArray = (obs[:, SPEED_Y] * np.cos(angle) - obs[:, SPEED_X] * np.sin(angle)) * SPEED
    return across


def free_view(obs: Array) -> tuple[FloatArray, FloatArray]:
    """Length, (n,) m, and direction, (n,) rad, positive to the left, of the longest range finder."""
    longest = obs[:, TRACK].argmax(axis=1)
    return obs[:, TRACK].max(axis=1) * RANGE, DIRECTIONS[longest]
