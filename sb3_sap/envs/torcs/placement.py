"""Where a car is placed on a road, written into TORCS' structures."""

from __future__ import annotations

import ctypes
import math
from typing import Any

from sb3_sap.envs.torcs.libraries import Shared
from sb3_sap.envs.torcs.road import Road

#: Limits of a placed car: |trackPos|, and height above the road, m.
MAX_TRACK_POS, MAX_HEIGHT = 1.0, 10.0


def check_place(distance: float, track_pos: float, angle: float, height: float) -> None:
    """Refuses places where TORCS' numbers would turn into NaN: not finite, or off the road."""
    if not all(map(math.isfinite, (distance, track_pos, angle, height))):
        raise ValueError(f"A car can only be placed at finite numbers, got {(distance, track_pos, angle, height)}.")
    if abs(track_pos) > MAX_TRACK_POS or not 0 <= height <= MAX_HEIGHT:
        raise ValueError(
            f"A car is placed on the road, at a track_pos in [-{MAX_TRACK_POS:g}, {MAX_TRACK_POS:g}] and a height "
            f"in [0, {MAX_HEIGHT:g}] m, got {track_pos!r} and {height!r}."
        )


def write_place(
    car: Any, road: Road, shared: Shared, distance: float, track_pos: float, angle: float, height: float
) -> None:
    """Writes the position on the road, and the pose that follows from it, into a car's structure.

    :param distance: m along the centre line from the start line
    :param track_pos: in [-1, 1]; +1 is the left edge
    :param angle: rad, road heading minus yaw
    :param height: m above the road
    """
    distance %= road.length
    segment = road.segment(distance)
    position, pose = car.position, car.pose
    position.segment = segment.address
    position.to_start = segment.to_start(distance - segment.from_start)
    position.to_middle = track_pos * segment.width / 2
    position.to_right = segment.width / 2 + position.to_middle
    position.to_left = segment.width - position.to_right
    at, x, y = ctypes.byref(position), ctypes.c_float(), ctypes.c_float()
    shared.to_global(at, ctypes.byref(x), ctypes.byref(y), 0)
    pose[0], pose[1] = x.value, y.value
    pose[2] = shared.height(at) + height
    pose[5] = (shared.heading(at) - angle) % (2 * math.pi)
