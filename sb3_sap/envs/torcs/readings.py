"""Reading TORCS' car: where it is, how fast, and what its engine does."""

from __future__ import annotations

import ctypes
import math
from typing import Any

from sb3_sap.envs.torcs.libraries import Shared
from sb3_sap.envs.torcs.road import Road, Segment
from sb3_sap.envs.torcs.structures import CarStructure


class CarReadings:
    """The state of one car on one road, read from TORCS' structures.

    :param road: the road on which it drives
    :param shared: the functions that TORCS' simulations share
    """

    def __init__(self, road: Road, shared: Shared):
        self.road = road
        self.length = road.length
        self.car: Any = CarStructure()
        self.shared = shared
        self._running = False  # whether the car is on the road
        self._position: Any = self.car.position
        # Looked up once, because ctypes makes a new object for each access.
        self._pose, self._velocity = self.car.pose, self.car.velocity
        self._wheels = list(self.car.wheels)
        self._at = ctypes.byref(self._position)

    @property
    def velocity(self) -> tuple[float, float, float]:
        """Velocity in the car's frame, m/s."""
        velocity = self._velocity
        return velocity[0], velocity[1], velocity[2]

    @property
    def pose(self) -> tuple[float, float, float]:
        """x and y of the centre of gravity [m] and yaw [rad], in the track's frame."""
        return self._pose[0], self._pose[1], self._pose[5]

    @property
    def heading(self) -> float:
        """Heading of the road where the car is, rad."""
        self._check_running()  # without a segment TORCS would read from address 0
        return self.shared.heading(self._at)  # type: ignore[no-any-return]

    @property
    def angle(self) -> float:
        """Road heading minus yaw, rad in [-π, π]."""
        return math.remainder(self.heading - self._pose[5], 2 * math.pi)

    @property
    def track_pos(self) -> float:
        """Distance to the left of the centre line, in half widths."""
        return 2 * self._position.to_middle / self._segment.width  # type: ignore[no-any-return]

    @property
    def distance(self) -> float:
        """m along the centre line from the start line, in [0, length)."""
        segment = self._segment
        return (segment.from_start + segment.along(self._position.to_start)) % self.length

    @property
    def wheel_spins(self) -> tuple[float, float, float, float]:
        """Spin of the wheels, rad/s: front right, front left, rear right, rear left."""
        front_right, front_left, rear_right, rear_left = self._wheels
        return front_right.spin, front_left.spin, rear_right.spin, rear_left.spin

    @property
    def engine_speed(self) -> float:
        """Speed of the engine, rad/s."""
        return self.car.engine_speed  # type: ignore[no-any-return]

    @property
    def gear(self) -> int:
        """The engaged gear."""
        return self.car.gear  # type: ignore[no-any-return]

    @property
    def red_line(self) -> float:
        """Highest speed of the car's engine, rad/s."""
        return self.car.red_line  # type: ignore[no-any-return]

    @property
    def top_gear(self) -> int:
        """The car's highest gear."""
        return self.car.n_gears - 1  # type: ignore[no-any-return]

    def gear_step(self, gear: int) -> float:
        """How many times faster the engine turns one gear lower; ``gear`` from 2."""
        ratios = self.car.gear_ratios
        return ratios[gear] / ratios[gear + 1]  # type: ignore[no-any-return]

    @property
    def damage(self) -> int:
        """Damage points."""
        return self.car.damage  # type: ignore[no-any-return]

    @property
    def _segment(self) -> Segment:
        self._check_running()
        return self.road.at_address[self._position.segment]

    def _check_running(self) -> None:
        if not self._running:
            raise RuntimeError("The car stands on no road yet, or the simulation is closed: call `place` first.")
