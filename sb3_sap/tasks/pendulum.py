"""``Pendulum-v1``, the hard case: what looks like a mistake is how a weak motor swings a pendulum up.

None of these AP functions is sound. They are here to measure what that costs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

Array = np.ndarray[Any, Any]

# Gymnasium's pendulum.py: θ'' = 15·sin θ + 3·torque, θ = 0 upright.
GRAVITY = 15.0


def pendulum_height(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """False where the pendulum lost height, which is what one would write first.

    *Unsound.* Swinging up means falling back again and again, whatever one does.

    :param obs: (n, 3) cos θ, sin θ, angular velocity
    :param actions: (n, 1) torque, from -2 to 2
    :param next_obs: (n, 3)
    :return: (n,) bool
    """
    del actions
    kept: BoolArray = next_obs[:, 0] >= obs[:, 0]
    return kept


def pendulum_torque(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """False where the torque turned the pendulum away from the top. Parameters as above.

    *Unsound*, and about the action itself: torque towards the top alone stalls where gravity holds against it.
    """
    away = actions[:, 0] * obs[:, 1] > 0
    still_away: BoolArray = away & (actions[:, 0] * next_obs[:, 1] > 0)
    return ~still_away


def pendulum_energy(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """False where the energy was off that of standing upright and the torque took it further off. Parameters as above.

    *Heuristic*, with the idea of the mountain cars: below that energy the motor must not brake, above it must not
    drive. The reward also prefers little torque and speed, and near the top a catch that energy does not show.
    """
    missing = -energy(next_obs)
    work = actions[:, 0] * np.sign(missing)  # positive: wanted in the direction of motion
    wrong: BoolArray = (work * obs[:, 2] < 0) & (work * next_obs[:, 2] < 0)
    return ~wrong


def energy(obs: Array) -> FloatArray:
    """Energy per moment of inertia, (n,) 1/s², of (n, 3) observations: 0 at rest upright, -30 at rest hanging."""
    value: FloatArray = 0.5 * obs[:, 2].astype(float) ** 2 + GRAVITY * (obs[:, 0].astype(float) - 1)
    return value
