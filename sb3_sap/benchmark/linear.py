"""What an engineer would try first: linear feedback, whose three gains were found by grid search on Wheel-2 alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.envs.car import STEERING_LOCK

#: steering = angle · angle/lock + track_pos · trackPos + speed_y · speedY/50, for each simulator. Those of
#: highway are what `benchmarks/linear_gains.py` finds. On TORCS that search finds (2.2, -4.8, 0.8), a little better on
#: Wheel-2 and clearly worse on the unseen tracks; those of a first, coarser search are kept, in the baseline's favour.
GAINS = {
    "torcs": {"angle": 2.5, "track_pos": -1.6, "speed_y": 1.0},
    "highway": {"angle": 5.2, "track_pos": -19.3, "speed_y": -12.8},
}


class LinearFeedback:
    """A policy as SB3's tools know it.

    :param angle: gain of the angle, in units of the steering lock
    :param track_pos: gain of the distance from the axis, in half widths
    :param speed_y: gain of the transverse speed, in 50 km/h
    """

    def __init__(self, angle: float, track_pos: float, speed_y: float):
        self.gains = np.array([angle / STEERING_LOCK, track_pos, 0.0, speed_y, 0.0], dtype=np.float32)

    def predict(self, obs: np.ndarray[Any, Any], deterministic: bool = True) -> tuple[np.ndarray[Any, Any], None]:
        """Steering for one observation, shape (5,), or several, shape (n, 5)."""
        steering: np.ndarray[Any, Any] = np.clip(obs @ self.gains, -1, 1)
        return steering[..., None], None
