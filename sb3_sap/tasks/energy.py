"""Climbing with a motor that is too weak: it is a mistake to add no energy while energy is missing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

# Gymnasium's mountain_car.py: per step, v' = v + push - GRAVITY·cos(3x), then x' = x + v'.
GRAVITY = 0.0025
#: Push of one action of ``MountainCar-v0``.
POWER = 0.001
#: Position x at which the slope before the flag pulls back exactly as hard as that push.
FLAG_BARRIER = math.acos(POWER / GRAVITY) / 3

#: Force along the motion below which a step counts as idle.
IDLE = 0.1

# Gymnasium's acrobot.py: both links are 1 m and 1 kg, their centres of mass in the middle, with 1 kg·m² of inertia.
ACROBOT_GRAVITY = 9.8
ACROBOT_INERTIA = 1.0
#: Lowest energy with the tip at the line, J: at rest, the first link level and the second upright.
LEAST_ENERGY_OF_GOAL = 0.5 * ACROBOT_GRAVITY


def mountain_car_continuous(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``MountainCarContinuous-v0``: False where the motor pushed against the motion, or along it by less than `IDLE`.

    *Argument.* The reward is 100 at the flag, less a tenth of each action squared. A push against the motion costs
    reward and takes out energy that must be put in again, while none at all is free: no optimal solution holds one.
    To idle is free, but delays the flag, and a learner discounts: at γ = 0.99 each step of delay costs 1 % of what the
    flag is worth, many times the 0.001 that a push of `IDLE` costs. Without discount, idling would be no mistake.

    :param obs: (n, 2) position, velocity
    :param actions: (n, 1) push, from -1 to 1
    :param next_obs: (n, 2)
    :return: (n,) bool
    """
    return _drives(actions[:, 0], obs[:, 1], next_obs[:, 1])


def mountain_car(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``MountainCar-v0``: False where the motor did not push along the motion; but to turn is no mistake where the flag
    is within reach.

    The flag is within reach where pushing right from now on gets there, which follows from energies: a constant push
    is a conservative force. A car that moves left there may push right, which is braking.

    *Heuristic.* Every step costs 1, and a car that lacks energy gains none by braking or idling. But where it will have
    energy to spare, braking can make a swing shorter by a step or two.

    :param obs: (n, 2) position, velocity
    :param actions: (n,) or (n, 1): 0 pushes left, 1 not at all, 2 right
    :param next_obs: (n, 2)
    :return: (n,) bool
    """
    push = actions.reshape(-1).astype(float) - 1
    return _drives(push, obs[:, 1], next_obs[:, 1]) | ((push > 0) & flag_within_reach(next_obs))


def flag_within_reach(obs: Array) -> BoolArray:
    """Where pushing right from now on leads to the flag of ``MountainCar-v0``; (n,) bool of (n, 2) observations."""
    x, v = obs[:, 0].astype(float), obs[:, 1].astype(float)
    reach: BoolArray = 0.5 * v**2 + _height_against_push(x) >= _height_against_push(FLAG_BARRIER)
    return reach


def _height_against_push(x: Any) -> Any:
    # Potential of gravity and of a push to the right together.
    return GRAVITY / 3 * np.sin(3 * x) - POWER * x


def acrobot(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """``Acrobot-v1``: False where the torque did not drive its joint on while the energy does not suffice for the goal.

    *Heuristic.* The torque puts energy in where it turns the joint the way it moves, and the goal needs more than there
    is at first. A fast swing-up may brake for a moment to set one link against the other.

    :param obs: (n, 6) cos and sin of both angles, both angular velocities
    :param actions: (n,) or (n, 1): 0 is a torque of -1, 1 none, 2 of +1
    :param next_obs: (n, 6)
    :return: (n,) bool
    """
    torque = actions.reshape(-1).astype(float) - 1
    return _drives(torque, obs[:, 5], next_obs[:, 5]) | (acrobot_energy(next_obs) >= LEAST_ENERGY_OF_GOAL)


def acrobot_energy(obs: Array) -> FloatArray:
    """Mechanical energy of both links, (n,) J, 0 where both are level at rest, of (n, 6) observations."""
    cos1, sin1, cos2, sin2, rate1, rate2 = obs.T.astype(float)
    # Of a link: at its centre of mass, and turning about it.
    speed1 = 0.25 * rate1**2
    both = rate1 + rate2
    speed2 = rate1**2 + 0.25 * both**2 + rate1 * both * cos2
    kinetic = 0.5 * (speed1 + speed2 + ACROBOT_INERTIA * (rate1**2 + both**2))
    height = -1.5 * cos1 - 0.5 * (cos1 * cos2 - sin1 * sin2)
    energy: FloatArray = kinetic + ACROBOT_GRAVITY * height
    return energy


def _drives(force: Array, velocity: Array, next_velocity: Array) -> BoolArray:
    """Where a force acted along the motion, as it was at the beginning of the step or at its end."""
    drives: BoolArray = (force * np.sign(velocity) >= IDLE) | (force * np.sign(next_velocity) >= IDLE)
    return drives
