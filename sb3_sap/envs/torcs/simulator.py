"""TORCS as a simulator of the lane-keeping task (`sb3_sap.envs.car.Simulator`)."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from sb3_sap.envs.car import CarState
from sb3_sap.envs.torcs.physics import TICK, Physics
from sb3_sap.envs.torcs.throttle import PERIOD_TICKS, SpeedHolder
from sb3_sap.envs.torcs.track_files import flatten
from sb3_sap.envs.tracks import read_track_xml
from sb3_sap.envs.units import KMH

#: Distance of the training start before the start line, m.
TRAINING_DISTANCE = 100.0
#: Names of the starts.
STARTS = ("training", "race")


class TorcsSimulator:
    """One car of TORCS, held at its default speed.

    :param track: name of a track that TORCS ships, or the path of a track file
    :param speed: default speed, km/h
    :param control_step: s between two actions, a multiple of 0.002
    :param car: name of a car that TORCS ships
    :param start: "training": 100 m before the line, on the axis; "race": the engine's own grid
    :raise ValueError: for what TORCS does not have or cannot do
    """

    def __init__(
        self,
        track: str | os.PathLike[str] = "wheel-2",
        speed: float = 50.0,
        control_step: float = 0.2,
        car: str = "car1-trb1",
        start: str = "training",
    ):
        check_start(start)
        if not (isinstance(speed, (int, float, np.number)) and 0 < speed <= 300):
            raise ValueError(f"speed must lie above 0 and not above 300 km/h, got {speed!r}.")
        ticks = step_ticks(control_step)
        self.simulation = Physics(track, car)
        self.control_step = control_step
        self.length = self.simulation.length
        self.track = read_track_xml(self.simulation.track_path)
        self.start = start_place(start, self.simulation.track_path, self.length)
        whole, rest = divmod(ticks, PERIOD_TICKS)
        self._periods = [PERIOD_TICKS] * whole + ([rest] if rest else [])
        self._throttle = SpeedHolder(speed)

    def reset(self, distance: float, track_pos: float, angle: float) -> CarState:
        """Put the car, at rest, on the road."""
        self.simulation.place(distance, track_pos, angle)
        self._throttle.reset()
        return self._state()

    def step(self, steering: float) -> CarState:
        """Drive one control step; throttle, brake and gear are decided every 0.02 s."""
        simulation, throttle = self.simulation, self._throttle
        for ticks in self._periods:
            accelerator, brake, gear = throttle.controls(simulation)
            simulation.control(steering, accelerator, brake, gear=gear)
            simulation.advance(ticks)
        return self._state()

    def drive(self, steering: float, pedal: float) -> CarState:
        """Drive one control step without holding a speed; ``pedal`` is from -1 (full brake) to 1 (full throttle)."""
        simulation, throttle = self.simulation, self._throttle
        for ticks in self._periods:
            simulation.control(steering, max(pedal, 0.0), max(-pedal, 0.0), gear=throttle.gear(simulation))
            simulation.advance(ticks)
        return self._state()

    def close(self) -> None:
        """Give TORCS' libraries back."""
        self.simulation.close()

    def _state(self) -> CarState:
        simulation = self.simulation
        x, y, z = simulation.velocity
        return CarState(simulation.angle, simulation.track_pos, x * KMH, y * KMH, z * KMH, simulation.distance)


def check_start(start: Any) -> None:
    """Refuses a start that is not one of `STARTS`."""
    if start not in STARTS:
        raise ValueError(f"start must be one of {', '.join(map(repr, STARTS))}, got {start!r}.")


def step_ticks(control_step: Any) -> int:
    """The number of the physics' ticks in a control step.

    :raise ValueError: unless it is a positive multiple of `TICK`
    """
    known = isinstance(control_step, (int, float, np.number)) and 0 < control_step < math.inf
    ticks = round(control_step / TICK) if known else 0
    if ticks < 1 or abs(ticks * TICK - control_step) > 1e-9:
        raise ValueError(f"control_step must be a positive multiple of {TICK} s, got {control_step!r}.")
    return ticks


def start_place(start: str, path: Path, length: float) -> dict[str, float]:
    """Distance (m), track_pos and angle (rad) of one of `STARTS`."""
    place = {"distance": length - TRAINING_DISTANCE, "track_pos": 0.0, "angle": 0.0}
    return place | race_grid(path, length) if start == "race" else place


def race_grid(path: Path, length: float) -> dict[str, float]:
    """The first place of the race engine's grid, as the track's own section says, else 100 m before the line."""
    root = ElementTree.fromstring(flatten(path))
    grid = root.find("section[@name='Starting Grid']")
    found = {} if grid is None else {item.get("name"): item.get("val", "") for item in grid}
    rows = max(int(float(found.get("rows", 1))), 1)
    distance = float(found.get("distance to start", TRAINING_DISTANCE))
    # The places of a row divide the width evenly; the pole position is the one nearest its side.
    offset = (rows - 1) / (rows + 1)
    side = 1 if found.get("pole position side", "right") == "left" else -1
    return {"distance": length - distance, "track_pos": side * offset}
