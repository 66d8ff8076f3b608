"""AP functions of lane keeping that are wrong on purpose: what a mistake in the user's knowledge costs."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from sb3_sap.common.arrays import BoolArray
from sb3_sap.envs.lane_keeping import ap_function

Array = np.ndarray[Any, Any]

#: One label in so many is wrong.
ONE_IN = 10
#: Position beside the centre line, in half widths of the road, beyond which every label is wrong, on the left only.
REGION = 0.2


def one_in_ten(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """Eq. (6), with one label in ten wrong, at states that a checksum of the next observation picks."""
    picked = [zlib.crc32(np.ascontiguousarray(row).tobytes()) % ONE_IN == 0 for row in next_obs]
    return np.logical_xor(ap_function(obs, actions, next_obs), picked)


def in_a_region(obs: Array, actions: Array, next_obs: Array) -> BoolArray:
    """Eq. (6), with every label wrong where the car is left of the centre line by more than `REGION`."""
    return np.logical_xor(ap_function(obs, actions, next_obs), obs[:, 1] > REGION)
