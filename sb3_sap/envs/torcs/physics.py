"""TORCS' physics of one car on one track, inside this process: place the car, control it, advance it tick by tick."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from typing import Any

from sb3_sap.envs.torcs.car_files import find_files, read_car
from sb3_sap.envs.torcs.installation import Installation, find_installation
from sb3_sap.envs.torcs.libraries import pool, reading
from sb3_sap.envs.torcs.placement import check_place, write_place
from sb3_sap.envs.torcs.probe import survives
from sb3_sap.envs.torcs.readings import CarReadings
from sb3_sap.envs.torcs.road import Road
from sb3_sap.envs.torcs.structures import PLACED, RUNNING, RaceStructure, SituationStructure
from sb3_sap.envs.torcs.tick_loop import tick_loop
from sb3_sap.envs.torcs.track_files import flatten

#: One step of the physics, s.
TICK = 0.002
#: Height above the road at which a car is placed, m.
DROP_HEIGHT = 0.2
#: Ticks for which the race engine lets the car come to rest with the brake on (one second).
SETTLE_TICKS = 500
#: Damage points, written into TORCS' situation.
MAX_DAMAGE = 10_000
#: Skill levels, from 0 (rookie) to 3 (pro), which change the grip of the tyres.
SKILL_LEVELS = range(4)
#: Highest gear of TORCS; a car ignores gears that it lacks.
MAX_GEAR = 8
#: Largest factor of fuel and damage.
MAX_FACTOR = 100.0
#: Number of places, and ticks at each, for which files that TORCS does not ship are tried out.
TRIAL_PLACES, TRIAL_TICKS = 40, 100


class Physics(CarReadings):
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
        files = find_files(track, car, installation)
        self.track_path = files.track
        track_file = flatten(files.track)
        unknown = files.unknown(installation)
        if unknown and not _trial:
            options = track, car, skill_level, fuel_factor, damage_factor, installation
            failure = survives(lambda: Physics(*options, _trial=True).drive_everywhere())
            if failure is not None:
                raise ValueError(
                    f"TORCS' own code {failure} with {' and '.join(map(str, unknown))}, which it does not ship: "
                    "compare it with a file that it does."
                )
        self._factors = float(fuel_factor), float(damage_factor)
        self._skill_level = skill_level
        self._pool = pool(installation)
        self._car_handle = read_car(self._pool.shared, files)
        self._library: Any = self._pool.acquire()
        self._running = False
        super().__init__(Road(self._library, track_file), self._pool.shared)
        self._make_structures()

    def _make_structures(self) -> None:
        self._situation: Any = SituationStructure()
        situation = ctypes.addressof(self._situation)
        self._run = tick_loop(self._library.update, situation, TICK)
        self._race: Any = RaceStructure()
        self._cars = (ctypes.c_void_p * 1)(ctypes.addressof(self.car))
        self._situation.n_cars = 1
        self._situation.delta_time = TICK
        self._situation.max_damage = MAX_DAMAGE
        self._situation.cars = ctypes.addressof(self._cars)
        self._race.car_list = ctypes.addressof(self.car)
        self._race.situation = situation
        self._race.track = ctypes.addressof(self.road.structure)

    def place(self, distance: float, track_pos: float = 0.0, angle: float = 0.0, height: float = DROP_HEIGHT) -> None:
        """Puts the car, at rest, on the road and lets it settle.

        :param distance: m along the centre line from the start line
        :param track_pos: in [-1, 1]; +1 is the left edge
        :param angle: rad, road heading minus yaw
        :param height: m above the road from which it is dropped
        """
        self._check_open()
        check_place(distance, track_pos, angle, height)
        if self._running:
            self._library.shutdown()
        ctypes.memset(ctypes.addressof(self.car), 0, ctypes.sizeof(self.car))
        self.car.skill_level, self.car.car_handle = self._skill_level, self._car_handle
        write_place(self.car, self.road, self.shared, distance, track_pos, angle, height)
        self._situation.race_state, self._situation.current_time = PLACED, 0.0
        self._library.init(1, ctypes.addressof(self.road.structure), *self._factors)
        self._running = True
        self._library.configure(ctypes.addressof(self.car), ctypes.addressof(self._race))
        self.advance(1, PLACED)
        self.car.brake = 1.0
        self.advance(SETTLE_TICKS, PLACED)

    def control(self, steer: float, accelerator: float, brake: float = 0.0, clutch: float = 0.0, gear: int = 1) -> None:
        """Sets the controls; they hold until set again, except for the throttle, which a shift cuts.

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
        if not self._running:
            self._check_running()
        self._situation.race_state = race_state
        if ticks > 0:
            self._run(ticks)

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
            self._pool.shared.release_parameters(self._car_handle)
        if hasattr(self, "road"):  # else the track is half built, and the next one in this copy would crash
            library.close_track()
            self._pool.release(library)

    def __del__(self, finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        # Environments are often dropped without being closed; the libraries are returned all the same. At the end of
        # Python its modules are empty, and there is no pool to return them to.
        if getattr(self, "_library", None) is not None and not finalizing():
            self.close()

    def _check_open(self) -> None:
        if self._library is None:
            raise RuntimeError("The simulation is closed: make a new one.")
