"""The 19 range finders of the SCR server: how far the edge of the road is in each direction.

The rays follow the road from where the car is. The nearest edge in the plane may be another's: Wheel-2 crosses over
itself.
"""

from __future__ import annotations

import cmath
import ctypes
import math
from bisect import bisect_right
from collections.abc import Sequence

from sb3_sap.envs.torcs.libraries import Shared
from sb3_sap.envs.torcs.road import Road
from sb3_sap.envs.torcs.structures import LocalPosition

#: Angle from one range finder to the next, rad.
SPACING = math.radians(10)
#: Directions relative to the car's axis, rad, positive to the left. The SCR server counts clockwise from -90°: the
#: first looks to the left, the last to the right.
DIRECTIONS = tuple(SPACING * (9 - i) for i in range(19))
#: Range, m: the reading where no edge is nearer.
RANGE = 200.0
#: Reading of all where the car is off the road, m.
OFF_ROAD = -1.0
#: Largest distance of an edge from the chords that stand for it, m.
TOLERANCE = 0.02
#: Length of the road that is followed, m along the centre line: more than the range, because rays may cut corners.
REACH = 1.3 * RANGE

#: A turn of each ray onto the car's axis: the conjugate of its direction.
_BACK = [cmath.rect(1, -direction) for direction in DIRECTIONS]


class RangeFinders:
    """The range finders of a car on one road.

    The edges are two rows of points, as complex numbers, at the same stations along the road. Rays that point forward
    along the road are cut with them station by station. In that order the first edge that a ray crosses is the nearest,
    and the rays cross the left edge from the left one on and the right edge from the right one on: each point is
    compared with one ray alone. Rays that point backward follow the road backward.
    """

    def __init__(self, road: Road, shared: Shared):
        stations = _stations(road)
        self._stations = stations
        # Three laps in a row, so that the road before and behind any station has no end.
        self._left, self._right = (3 * points for points in _edges(road, shared, stations))
        laps = [station + lap * road.length for lap in (-1, 0, 1) for station in stations]
        n = len(stations)
        self._before = [bisect_right(laps, station + REACH) + 1 for station in stations]
        self._behind = [max(bisect_right(laps, station - REACH) - 2, -1) for station in stations]
        self._lap = n

    def measure(self, x: float, y: float, yaw: float, angle: float, distance: float) -> list[float]:
        """Distances to the edges, m, from left to right, of a car on the road.

        :param x: of the car, m
        :param y: of the car, m
        :param yaw: of the car, rad
        :param angle: road heading minus yaw, rad in [-π, π]
        :param distance: m along the centre line, in [0, length)
        """
        car, turn = complex(x, y), cmath.rect(1, -yaw)
        rays = [back * turn for back in _BACK]
        found = [RANGE] * len(rays)
        station = bisect_right(self._stations, distance) - 1
        here = station + self._lap
        last = len(rays) - 1
        backward = min(math.ceil(abs(angle) / SPACING), last)
        ahead, behind = (0, last - backward), (last - backward + 1, last)
        if angle < 0:
            ahead, behind = (backward, last), (0, backward - 1)
        _follow(self._left, self._right, range(here, self._before[station]), car, rays, *ahead, found)
        if backward:
            back = range(here + 1, self._behind[station], -1)
            _follow(self._right, self._left, back, car, rays, *behind, found)
        return found


def _follow(
    clockwise: Sequence[complex],
    anticlockwise: Sequence[complex],
    stations: range,
    car: complex,
    rays: list[complex],
    low: int,
    high: int,
    found: list[float],
) -> None:
    """Writes into ``found`` where the rays from ``low`` to ``high`` leave the road.

    :param clockwise: the edge that is seen turning clockwise, from ray ``low`` on, as the stations go by
    :param anticlockwise: the other edge, from ray ``high`` back
    """
    # Slices rather than indices, and rays in variables: this is the innermost loop of every step.
    ends = slice(stations.start, stations.stop if stations.stop >= 0 else None, stations.step)
    left_behind, right_behind = clockwise[stations.start] - car, anticlockwise[stations.start] - car
    low_ray, high_ray = rays[low], rays[high]
    for one, other in zip(clockwise[ends], anticlockwise[ends], strict=True):
        here, there = one - car, other - car
        while (to := here * low_ray).imag <= 0 < (since := left_behind * low_ray).imag:
            metres = since.real + (to.real - since.real) * since.imag / (since.imag - to.imag)
            if metres <= 0:
                break
            found[low] = min(metres, RANGE)
            low += 1
            if low > high:
                return
            low_ray = rays[low]
        while (to := there * high_ray).imag >= 0 > (since := right_behind * high_ray).imag:
            metres = since.real + (to.real - since.real) * since.imag / (since.imag - to.imag)
            if metres <= 0:
                break
            found[high] = min(metres, RANGE)
            high -= 1
            if low > high:
                return
            high_ray = rays[high]
        left_behind, right_behind = here, there


def _stations(road: Road) -> list[float]:
    """Distances along the centre line at which the edges have points, m: their chords keep the `TOLERANCE`."""
    stations = []
    for segment, end in zip(road.segments, [*(s.from_start for s in road.segments[1:]), road.length], strict=True):
        length, count = end - segment.from_start, 1
        if not segment.straight:
            outer = segment.radius + segment.width / 2
            chord = math.sqrt(8 * outer * TOLERANCE)  # m at the outer edge, whose arcs are the longest
            count = math.ceil(length * outer / segment.radius / chord)
        stations += [segment.from_start + length * i / count for i in range(count)]
    return stations


def _edges(road: Road, shared: Shared, stations: list[float]) -> tuple[list[complex], list[complex]]:
    """The points of the left and the right edge, m."""
    position = LocalPosition()
    at, x, y = ctypes.byref(position), ctypes.c_float(), ctypes.c_float()
    edges: tuple[list[complex], list[complex]] = ([], [])
    for distance in stations:
        segment = road.segment(distance)
        position.segment = segment.address
        position.to_start = segment.to_start(distance - segment.from_start)
        for points, to_right in zip(edges, (segment.width, 0.0), strict=True):
            position.to_right = to_right
            position.to_middle = to_right - segment.width / 2
            position.to_left = segment.width - to_right
            shared.to_global(at, ctypes.byref(x), ctypes.byref(y), 0)
            points.append(complex(x.value, y.value))
    return edges
