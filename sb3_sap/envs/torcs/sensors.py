"""The sensors of the SCR server, by the names of its manual (Loiacono et al., arXiv 1304.1672, table 1).

Those of a car alone on the road are here; fuel, times and the opponents' are not observed.
"""

from __future__ import annotations

import ctypes
import math
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.torcs.range_finders import DIRECTIONS, OFF_ROAD, RANGE, RangeFinders
from sb3_sap.envs.torcs.structures import CarStructure, LocalPosition, Wheel
from sb3_sap.envs.units import KMH

#: Names of the entries of an observation, in their order. The range finders count from the left to the right.
NAMES = (
    "angle",
    *(f"track[{i}]" for i in range(len(DIRECTIONS))),
    "trackPos",
    "speedX",
    "speedY",
    "speedZ",
    *(f"wheelSpinVel[{i}]" for i in range(4)),
    "rpm",
    "gear",
)
#: Index of each name.
INDEX = {name: i for i, name in enumerate(NAMES)}
#: Slices of the range finders; of trackPos and the three speeds; and of the wheels' spins.
TRACK = slice(INDEX["track[0]"], INDEX["trackPos"])
MOTION = slice(INDEX["trackPos"], INDEX["wheelSpinVel[0]"])
SPINS = slice(INDEX["wheelSpinVel[0]"], INDEX["rpm"])
#: Unit of each entry: rad; m; half widths; km/h; rad/s; 1/min; 1. An entry of the observation is the raw reading in
#: its unit.
UNITS = np.array([1.0, *(RANGE,) * 19, 1.0, 100.0, 100.0, 100.0, *(100.0,) * 4, 10_000.0, 6.0])
#: Magnitudes at which raw readings are clipped.
LIMITS = np.array([math.pi, *(RANGE,) * 19, 2.0, 400.0, 400.0, 400.0, *(1_000.0,) * 4, 20_000.0, 8.0])
#: The same for observations.
_SCALES, _BOUNDS = (1 / UNITS).astype(np.float32), (LIMITS / UNITS).astype(np.float32)
#: Revolutions per minute in a rad/s.
RPM = 60 / math.tau


class Reading(NamedTuple):
    """What is read of a car at once."""

    sensors: list[float]  # raw, in the order of `NAMES`
    distance: float  # m along the centre line from the start line, in [0, length)
    damage: int  # points


def _members() -> dict[int, str]:
    """Offsets and types of the members that are read, of a car's structure."""
    members: Any = CarStructure
    position, wheels = members.position.offset, members.wheels.offset
    spin: Any = Wheel
    where: Any = LocalPosition
    return {
        members.pose.offset: "6f",
        members.velocity.offset: "3f",
        position + where.segment.offset: "Q",
        position + where.to_start.offset: "f",
        position + where.to_middle.offset: "f",
        **{wheels + ctypes.sizeof(spin) * wheel + spin.spin.offset: "f" for wheel in range(4)},
        members.gear.offset: "i",
        members.engine_speed.offset: "f",
        members.damage.offset: "i",
    }


def _layout(members: dict[int, str]) -> tuple[struct.Struct, int]:
    """What reads all members in one call, and the offset from which it does."""
    first = end = min(members)
    layout = "<"
    for offset in sorted(members):
        layout += f"{offset - end}x{members[offset]}"
        end = offset + struct.calcsize("<" + members[offset])
    return struct.Struct(layout), first


_READ, _FIRST = _layout(_members())


class Sensors:
    """The sensors of one car on one road."""

    def __init__(self, simulation: Physics):
        self._simulation = simulation
        self._range_finders = RangeFinders(simulation.road, simulation.shared)

    def read(self) -> Reading:
        """Reads all at once."""
        simulation = self._simulation
        read = _READ.unpack_from(simulation.car, _FIRST)
        (x, y, _, _, _, yaw, speed_x, speed_y, speed_z, address, to_start, to_middle, *spins, gear, engine, damage) = (
            read
        )
        road = simulation.road
        segment = road.at_address[address]
        distance = (segment.from_start + segment.along(to_start)) % road.length
        track_pos = 2 * to_middle / segment.width
        angle = math.remainder(simulation.heading - yaw, math.tau)
        on_road = -1 <= track_pos <= 1  # and a number
        track = self._range_finders.measure(x, y, yaw, angle, distance) if on_road else [OFF_ROAD] * len(DIRECTIONS)
        sensors = [angle, *track, track_pos, speed_x * KMH, speed_y * KMH, speed_z * KMH, *spins, engine * RPM, gear]
        return Reading(sensors, distance, damage)


def observation(sensors: list[float]) -> NDArray[np.float32]:
    """The observation, (30,), of raw readings: clipped at `LIMITS`, in `UNITS`."""
    scaled = np.array(sensors, dtype=np.float32)
    scaled *= _SCALES
    np.maximum(scaled, -_BOUNDS, out=scaled)
    np.minimum(scaled, _BOUNDS, out=scaled)
    return scaled
