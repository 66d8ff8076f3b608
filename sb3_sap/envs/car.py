"""The car of the lane-keeping task, and what a simulator must provide to move it."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from sb3_sap.envs.tracks import Track

#: Angle that the front wheels turn at steering 1, rad (21°, Table 1).
STEERING_LOCK = 0.366519


class CarState(NamedTuple):
    """What the task needs to know of the car (Table 1)."""

    #: rad, in [-pi, pi]: road heading minus yaw; positive when the car points to the right of the road.
    #:
    #: The sign is that of TORCS' sensors: positive steering corrects a positive angle.
    angle: float
    #: 2 · (distance to the left of the centre line, or axis) / width: 1 at the left edge, -1 at the right.
    track_pos: float
    #: km/h, along the car's longitudinal axis.
    speed_x: float
    #: km/h, along its transverse axis, positive to the left.
    speed_y: float
    #: km/h, along its vertical axis.
    speed_z: float
    #: m along the centre line from the start line, in [0, length).
    distance: float


class Simulator(Protocol):
    """Where the car drives: one car on one track, held at its default speed."""

    #: Plan geometry, for the viewer.
    track: Track
    #: m, one lap along the centre line.
    length: float
    #: s, between two actions.
    control_step: float
    #: Default start of the car: the arguments of `reset`.
    start: dict[str, float]

    def reset(self, distance: float, track_pos: float, angle: float) -> CarState:
        """Put the car on the road, with the units and signs of `CarState`, and return its state."""
        ...

    def step(self, steering: float) -> CarState:
        """Drive one control step with the steering (in [-1, 1], positive to the left) held."""
        ...

    def close(self) -> None:
        """Release what the simulator holds."""
        ...
