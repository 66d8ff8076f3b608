"""TORCS' physics of one car on one track, inside this process: place the car, control it, advance it tick by tick."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_sap.envs.torcs.installation import Installation, find_installation
from sb3_sap.envs.torcs.libraries import MERGE_ALL, READ_STANDARD, pool, reading
from sb3_sap.envs.torcs.probe import survives
from sb3_sap.envs.torcs.road import Road, Segment
from sb3_sap.envs.torcs.structures import (
    PLACED,
    RUNNING,
    CarStructure,
    RaceStructure,
    SituationStructure,
)
from sb3_sap.envs.torcs.track_files import flatten

TICK = 0.002
"""s, one step of the physics."""
DROP_HEIGHT = 0.2
"""m above the road at which a car is placed."""
SETTLE_TICKS = 500
"""The race engine lets the car come to rest with the brake on, for one second."""
MAX_DAMAGE = 10_000
SKILL_LEVELS = range(4)
"""0 rookie to 3 pro; the level changes the grip of the tyres."""
MAX_GEAR = 8
"""What TORCS has room for; a car ignores gears that it lacks."""
MAX_FACTOR = 100.0
"""Of fuel and damage."""
MAX_TRACK_POS, MAX_HEIGHT = 1.0, 10.0
"""A car is placed on the road, and at most so many metres above it."""
TRIAL_PLACES, TRIAL_TICKS = 40, 100
"""Where, and how long, files that TORCS does not ship are tried out."""


class Simulation:
    """One car on one track.

    :param track: name of a track that TORCS ships, or the path of a track file
    :param car: name of a car that TORCS ships
    :param skill_level: 0 (rookie) to 3 (pro)
    :param fuel_factor: fuel used, relative to the car's own; 0 keeps it the same on every lap
    :param damage_factor: damage taken, relative to TORCS' own
    :param installation: TORCS; None: the one that is found
    :raise TorcsNotFoundError: if there is no TORCS that can be used
    :raise ValueError: for a track, a car or a level that does not exist, or a damaged track file
    """

    def __init__(
        self,
        track: str | os.PathLike[str] = "wheel-2",
        car: str = "car1-trb1",
        skill_level: int = 0,
        fuel_factor: float = 0.0,
        damage_factor: float = 0.0,
        installation: Installation | None = None,
        _trial: bool = False,
    ):
        installation = installation or find_installation()
        if skill_level not in SKILL_LEVELS:
            raise ValueError(f"skill_level must be from 0 (rookie) to 3 (pro), got {skill_level!r}.")
        for name, factor in (("fuel_factor", fuel_factor), ("damage_factor", damage_factor)):
            if not 0 <= factor <= MAX_FACTOR:
                raise ValueError(f"{name} must lie in [0, {MAX_FACTOR:g}], got {factor!r}.")
        path = Path(track)
        self.track_path = path if path.suffix == ".xml" and path.is_file() else installation.track(str(track))
        track_file = flatten(self.track_path)
        car_file = installation.car(car)
        category_file = installation.category(car_category(car_file))
        surfaces = installation.surfaces()
        if surfaces.is_file() and not installation.is_original(surfaces):
            # It would load, with another grip on every track.
            raise ValueError(
                f"{surfaces}, the road surfaces, is not the one that TORCS ships: install TORCS' data again."
            )
        unknown = [f for f in (self.track_path, car_file, category_file) if not installation.is_original(f)]
        if unknown and not _trial:
            options = track, car, skill_level, fuel_factor, damage_factor, installation
            fate = survives(lambda: Simulation(*options, _trial=True).drive_everywhere())
            if fate is not None:
                raise ValueError(
                    f"TORCS' own code {fate} with {' and '.join(map(str, unknown))}, which it does not ship: compare "
                    "it with a file that it does."
                )
        self._factors = float(fuel_factor), float(damage_factor)
        self._skill_level = skill_level
        self._pool = pool(installation)
        self._shared = self._pool.shared
        self._car_handle = self._read_car(car_file, category_file)
        self._library: Any = self._pool.acquire()
        self._running = False
        self.road = Road(self._library, track_file)
        self.length = self.road.length
        self._make_structures()

    def _read_car(self, car_file: Path, category_file: Path) -> Any:
        with reading():
            handles = [
                self._shared.read_parameters(str(file).encode(), READ_STANDARD) for file in (category_file, car_file)
            ]
            if not all(handles):
                raise ValueError(f"TORCS cannot read {car_file} with {category_file}: install TORCS' data again.")
            return self._shared.merge(*handles, MERGE_ALL)

    def _make_structures(self) -> None:
        self.car: Any = CarStructure()
        self._position: Any = self.car.position
        self._situation: Any = SituationStructure()
        self._race: Any = RaceStructure()
        self._cars = (ctypes.c_void_p * 1)(ctypes.addressof(self.car))
        self._situation.n_cars = 1
        self._situation.delta_time = TICK
        self._situation.max_damage = MAX_DAMAGE
        self._situation.cars = ctypes.addressof(self._cars)
        self._race.car_list = ctypes.addressof(self.car)
        self._race.situation = ctypes.addressof(self._situation)
        self._race.track = ctypes.addressof(self.road.structure)
        self._pose, self._velocity = self.car.pose, self.car.velocity
        self._wheels = list(self.car.wheels)
        self._at = ctypes.byref(self._position)

    def place(self, distance: float, track_pos: float = 0.0, angle: float = 0.0, height: float = DROP_HEIGHT) -> None:
        """Puts the car, at rest, on the road and lets it settle.

        :param distance: m along the centre line from the start line
        :param track_pos: in [-1, 1]; +1 is the left edge
        :param angle: rad, road heading minus yaw
        :param height: m above the road from which it is dropped
        """
        self._check_open()
        if not all(map(math.isfinite, (distance, track_pos, angle, height))):
            raise ValueError(f"A car can only be placed at finite numbers, got {(distance, track_pos, angle, height)}.")
        if abs(track_pos) > MAX_TRACK_POS or not 0 <= height <= MAX_HEIGHT:
            # Far off the road TORCS' numbers turn into NaN.
            raise ValueError(
                f"A car is placed on the road, at a track_pos in [-{MAX_TRACK_POS:g}, {MAX_TRACK_POS:g}] and a height "
                f"in [0, {MAX_HEIGHT:g}] m, got {track_pos!r} and {height!r}."
            )
        distance %= self.length
        segment = self.road.segment(distance)
        if self._running:
            self._library.shutdown()
        ctypes.memset(ctypes.addressof(self.car), 0, ctypes.sizeof(self.car))
        self.car.skill_level, self.car.car_handle = self._skill_level, self._car_handle
        position = self._position
        position.segment = segment.address
        position.to_start = segment.to_start(distance - segment.from_start)
        position.to_middle = track_pos * segment.width / 2
        position.to_right = segment.width / 2 + position.to_middle
        position.to_left = segment.width - position.to_right
        x, y = ctypes.c_float(), ctypes.c_float()
        self._shared.to_global(self._at, ctypes.byref(x), ctypes.byref(y), 0)
        self._pose[0], self._pose[1] = x.value, y.value
        self._pose[2] = self._shared.height(self._at) + height
        self._pose[5] = (self._shared.heading(self._at) - angle) % (2 * math.pi)
        self._situation.race_state, self._situation.current_time = PLACED, 0.0
        self._library.init(1, ctypes.addressof(self.road.structure), *self._factors)
        self._running = True
        self._library.configure(ctypes.addressof(self.car), ctypes.addressof(self._race))
        self.advance(1, PLACED)
        self.car.brake = 1.0
        self.advance(SETTLE_TICKS, PLACED)

    def control(self, steer: float, accelerator: float, brake: float = 0.0, clutch: float = 0.0, gear: int = 1) -> None:
        """Sets the controls; they hold until set again, but for the throttle, which a shift cuts.

        :param steer: -1 (right) to 1 (left)
        :param accelerator: 0 to 1
        :param brake: 0 to 1
        :param clutch: 0 to 1
        :param gear: -1 (reverse) to the highest
        """
        if not (
            -1 <= steer <= 1
            and 0 <= accelerator <= 1
            and 0 <= brake <= 1
            and 0 <= clutch <= 1
            and -1 <= gear <= MAX_GEAR
        ):
            raise ValueError(
                f"Controls must lie in -1..1 (steer), 0..1 (accelerator, brake, clutch) and -1..{MAX_GEAR} (gear), got "
                f"{steer}, {accelerator}, {brake}, {clutch}, {gear}."
            )
        car = self.car
        car.steer, car.accelerator, car.brake, car.clutch, car.gear_command = steer, accelerator, brake, clutch, gear

    def advance(self, ticks: int, race_state: int = RUNNING) -> None:
        """Advances the physics by a number of ticks of 2 ms."""
        self._check_running()
        self._situation.race_state = race_state
        update, situation = self._library.update, ctypes.addressof(self._situation)
        for _ in range(ticks):
            update(situation, TICK, -1)

    @property
    def velocity(self) -> tuple[float, float, float]:
        """In the car's frame, m/s."""
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
        return self._shared.heading(self._at)  # type: ignore[no-any-return]

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
        """rad/s."""
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

    def drive_everywhere(self) -> None:
        """Places the car at many places and drives a little, to see whether TORCS survives it."""
        for i in range(TRIAL_PLACES):
            self.place(i / TRIAL_PLACES * self.length)
            for steer in (1.0, -1.0):
                self.control(steer, 1.0)
                self.advance(TRIAL_TICKS)

    def close(self) -> None:
        """Gives the libraries back; the simulation can no longer be used."""
        library, self._library = self._library, None
        if library is None:
            return
        if self._running:
            library.shutdown()
            self._running = False
        with reading():
            self._shared.release_parameters(self._car_handle)
        if hasattr(self, "road"):  # else the track is half built, and the next one in this copy would crash
            library.close_track()
            self._pool.release(library)

    def __del__(self, finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        # Environments are often dropped without being closed; the libraries go back all the same. As Python ends it
        # empties its modules, this one too, and there is nobody left to give them back to.
        if getattr(self, "_library", None) is not None and not finalizing():
            self.close()

    def _check_running(self) -> None:
        if not self._running:
            raise RuntimeError("The car stands on no road yet, or the simulation is closed: call `place` first.")

    def _check_open(self) -> None:
        if self._library is None:
            raise RuntimeError("The simulation is closed: make a new one.")


def car_category(path: Path) -> str:
    """The category that a car's file names."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a readable TORCS car file ({error}): install TORCS' data again.") from error
    found = root.find("section[@name='Car']/attstr[@name='category']")
    if found is None:
        raise ValueError(f"{path} names no category in its section 'Car': install TORCS' data again.")
    return found.get("val", "")
