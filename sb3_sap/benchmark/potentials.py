"""Potentials for reward shaping, a rival of the label: the AP function of each task asks that one of these not fall.

Ng, Harada and Russell (1999) show that shaping with a potential leaves the optimal policies as they are. How large it
must be in units of the reward, to be of use, has to be tried.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.common.arrays import FloatArray
from sb3_sap.tasks.energy import GRAVITY

Array = np.ndarray[Any, Any]


def centre_30(obs: Array) -> FloatArray:
    """Lane keeping: minus the distance from the centre line, 30 at the edge of the road; a step pays at most 50."""
    return -30.0 * _from_centre(obs)


def centre_100(obs: Array) -> FloatArray:
    """The same, 100 at the edge."""
    return -100.0 * _from_centre(obs)


def centre_300(obs: Array) -> FloatArray:
    """The same, 300 at the edge."""
    return -300.0 * _from_centre(obs)


def energy_1(obs: Array) -> FloatArray:
    """``MountainCarContinuous-v0``: the car's energy, 1 between the valley and the flag; a step costs at most 0.1."""
    return _energy(obs)


def energy_10(obs: Array) -> FloatArray:
    """The same, 10 between the valley and the flag."""
    return 10.0 * _energy(obs)


def energy_100(obs: Array) -> FloatArray:
    """The same, 100 between the valley and the flag, which pays 100."""
    return 100.0 * _energy(obs)


def _from_centre(obs: Array) -> FloatArray:
    distance: FloatArray = np.abs(obs[:, 1]).astype(np.float64)
    return distance


def _energy(obs: Array) -> FloatArray:
    """(n,) above that of rest in the valley, in units of what the flag at 0.45 is higher."""
    position, velocity = obs[:, 0].astype(np.float64), obs[:, 1].astype(np.float64)
    height = GRAVITY / 3 * (1.0 + np.sin(3.0 * position))  # whose derivative is the GRAVITY·cos(3x) of a step
    at_flag = GRAVITY / 3 * (1.0 + np.sin(3.0 * 0.45))
    energy: FloatArray = (0.5 * velocity**2 + height) / at_flag
    return energy
