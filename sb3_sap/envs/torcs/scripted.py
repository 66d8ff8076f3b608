"""A driver of ``sap/TorcsRacing-v0`` that is written down, not trained, and uses the observation alone.

It steers to where the free view is longest, at a speed from which it could stop within that view. That it laps every
track shows that the observation suffices; a trained policy is measured against it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.torcs.range_finders import DIRECTIONS
from sb3_sap.envs.torcs.sensors import INDEX, SPINS, TRACK, UNITS
from sb3_sap.envs.units import KMH

#: Deceleration with which the car could stop within its view, m/s². The tyres would do more than twice that, but they
#: steer as well. With 12 it still laps the five tracks, faster, but leaves others.
DECELERATION = 10.0
#: End of the view that is not used, m.
MARGIN = 3.0
#: Range finders to each side of the longest that have a say in the direction.
NEIGHBOURS = 2
#: Steering for a direction of one steering lock, and the speed at which half of it is left, m/s.
GAIN, HALF_SPEED = 1.1, 36.0
#: Steering against a drift of 1 rad, the angle between where the car goes and where it points.
DRIFT_GAIN = 0.75
#: Pedal per m/s of missing speed.
PEDAL_GAIN = 0.1
#: Radius of the wheels, m.
WHEEL_RADIUS = 0.32
#: Speed of the tyres over the road above which throttle and brake are taken back, and that at which little is left,
#: m/s.
SPIN, LOCK, SLIP_RANGE = 4.0, 5.0, 5.0
#: Fraction of the brake that remains at least.
LEAST_BRAKE = 0.2


class ScriptedDriver:
    """Drives by the range finders, with the `predict` of Stable-Baselines3's models.

    :param deceleration: with which the car could stop within its view, m/s²; less is slower
    """

    def __init__(self, deceleration: float = DECELERATION):
        if not 0 < deceleration < math.inf:
            raise ValueError(f"deceleration must be a positive number of m/s², got {deceleration!r}.")
        self.deceleration = deceleration

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Actions, (2,) or (n, 2), for observations, (30,) or (n, 30); the other arguments have no effect."""
        if observation.shape[-1:] != UNITS.shape:
            raise ValueError(
                f"observation must be that of sap/TorcsRacing-v0, (30,), but has shape {observation.shape}."
            )
        if observation.ndim == 1:
            return np.array(self._drive(observation), dtype=np.float32), None
        return np.array([self._drive(row) for row in observation], dtype=np.float32).reshape(-1, 2), None

    def _drive(self, observation: NDArray[Any]) -> tuple[float, float]:
        raw = (observation * UNITS).tolist()
        view = raw[TRACK]
        speed, sideways = raw[INDEX["speedX"]] / KMH, raw[INDEX["speedY"]] / KMH
        longest = max(range(len(view)), key=view.__getitem__)
        near = range(max(longest - NEIGHBOURS, 0), min(longest + NEIGHBOURS + 1, len(view)))
        free = sum(view[i] * DIRECTIONS[i] for i in near) / sum(view[i] for i in near)
        drift = math.atan2(sideways, max(speed, 5.0))
        steering = GAIN * free / STEERING_LOCK / (1 + speed / HALF_SPEED) - DRIFT_GAIN * drift
        target = math.sqrt(2 * self.deceleration * max(view[longest] - MARGIN, 0.0))
        pedal = min(max(PEDAL_GAIN * (target - speed), -1.0), 1.0)
        return min(max(steering, -1.0), 1.0), _without_slip(pedal, speed, raw[SPINS])


def _without_slip(pedal: float, speed: float, spins: list[float]) -> float:
    """Takes the pedal back where the driven wheels spin, or a wheel locks."""
    if pedal > 0:
        spin = (spins[2] + spins[3]) / 2 * WHEEL_RADIUS - speed
        return pedal * min(max(1 - (spin - SPIN) / SLIP_RANGE, 0.0), 1.0)
    lock = speed - min(spins) * WHEEL_RADIUS
    return pedal * min(max(1 - (lock - LOCK) / SLIP_RANGE, LEAST_BRAKE), 1.0)
