"""The embedded simulator: highway-env's `BicycleVehicle` on a road built from highway-env's lanes.

highway-env draws y downwards and calls a positive heading clockwise. Its formulas do not depend on that: read with y
upwards, as here, positive headings, steering and lateral offsets are all to the left.
"""

from __future__ import annotations

import math
import os

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, StraightLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.dynamics import BicycleVehicle

from sb3_sap.envs.car import STEERING_LOCK, CarState
from sb3_sap.envs.tracks import Piece, Track, get_track
from sb3_sap.envs.units import KMH

#: Bounds of the default speed, km/h. Below them highway-env's model damps all turning; above them it brakes.
MIN_SPEED, MAX_SPEED = 5.0, 144.0
#: Longest step of the integration at `SUB_STEP_SPEED` and above, s (see `HighwaySimulator`).
SUB_STEP = 0.05
#: Speed below which the longest step shrinks in proportion to the speed, km/h.
SUB_STEP_SPEED = 50.0


def road_lane(piece: Piece, width: float) -> AbstractLane:
    """Return the piece of a track as highway-env's lane of ``width`` m."""
    if not piece.curvature:
        return StraightLane(piece.point(0.0)[:2], piece.point(piece.length)[:2], width)
    radius = 1 / piece.curvature  # signed: the centre lies this far to the left
    centre_x, centre_y, _ = piece.point(0.0, radius)
    phase = piece.heading - math.copysign(math.pi / 2, radius)  # of the start, seen from the centre
    turn = piece.length * piece.curvature
    return CircularLane((centre_x, centre_y), abs(radius), phase, phase + turn, clockwise=radius > 0, width=width)


def road_network(track: Track) -> RoadNetwork:
    """Return the track as a ring of highway-env lanes, one per piece, between the nodes "0", "1", …"""
    network = RoadNetwork()
    for index, piece in enumerate(track.pieces):
        network.add_lane(str(index), str((index + 1) % len(track.pieces)), road_lane(piece, track.width))
    return network


class HighwaySimulator:
    """A car with linear tyres (Rajamani, 2011, chapter 2; wheelbase 5 m) at constant speed on a flat road.

    The car starts at the default speed, without lateral speed or yaw rate. highway-env's RK4 integrates its motion in
    equal sub-steps. The yaw rate decays at 155/V (1/s, V in m/s): a step in proportion to V keeps the integration
    stable; its error is below 0.1 mm per control step up to 50 km/h.

    :param track: as `get_track` takes it
    :param speed: default speed, km/h
    :param control_step: s between two actions
    :raise ValueError: if the speed or the control step cannot be driven with, or the track is unknown
    """

    def __init__(
        self, track: str | os.PathLike[str] | Track = "wheel-2", speed: float = 50.0, control_step: float = 0.2
    ) -> None:
        if not (isinstance(speed, (int, float, np.number)) and MIN_SPEED <= speed <= MAX_SPEED):
            raise ValueError(f"speed must lie in [{MIN_SPEED:g}, {MAX_SPEED:g}] km/h, got {speed!r}.")
        if not (isinstance(control_step, (int, float, np.number)) and math.isfinite(control_step) and control_step > 0):
            raise ValueError(f"control_step must be a positive number of seconds, got {control_step!r}.")
        self.track = get_track(track)
        self.length = self.track.length
        self.control_step = control_step
        self.start = {"distance": 0.0, "track_pos": 0.0, "angle": 0.0}
        self.speed = speed
        self._sub_steps = math.ceil(control_step / (SUB_STEP * min(speed / SUB_STEP_SPEED, 1.0)))
        self.network = road_network(self.track)
        self._lanes: list[AbstractLane] = self.network.lanes_list()
        self._piece = 0

    def reset(self, distance: float, track_pos: float, angle: float) -> CarState:
        """Put the car at ``distance`` m, at ``track_pos``, pointing ``angle`` rad to the right of the road."""
        x, y, heading = self.track.position(distance, track_pos * self.track.width / 2)
        self._piece = self.track.piece_at(distance)
        # Without a road, the vehicle does not look for the nearest of all lanes, which may be the wrong one.
        self.vehicle = BicycleVehicle(None, (x, y), heading - angle, self.speed / KMH)
        return self._state()

    def step(self, steering: float) -> CarState:
        """Drive one control step with ``steering`` (in [-1, 1], positive to the left) held."""
        self.vehicle.act({"steering": steering * STEERING_LOCK, "acceleration": 0.0})
        for _ in range(self._sub_steps):
            self.vehicle.step(self.control_step / self._sub_steps)
        return self._state()

    def close(self) -> None:
        """Do nothing: no resource is held."""

    def _state(self) -> CarState:
        x, y = self.vehicle.position.tolist()
        distance, lateral, heading, self._piece = self.track.locate(x, y, self._piece)
        self.vehicle.lane = self._lanes[self._piece]
        return CarState(
            angle=(heading - float(self.vehicle.heading) + math.pi) % (2 * math.pi) - math.pi,
            track_pos=2 * lateral / self.track.width,
            speed_x=float(self.vehicle.speed) * KMH,
            speed_y=float(self.vehicle.lateral_speed) * KMH,
            speed_z=0.0,
            distance=distance,
        )
