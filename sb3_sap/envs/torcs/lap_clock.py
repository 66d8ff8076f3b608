"""Progress along a closed road, and the times of the laps that it completes."""

from __future__ import annotations

import math

#: A car stalls unless it gets that many m forward within that many s. A standing start takes it there in 2 s.
PROGRESS, PROGRESS_TIME = 10.0, 5.0


class LapClock:
    """Counts the metres and laps of a car from where it starts.

    :param distance: of the start, m along the centre line
    :param length: of a lap, m
    :param control_step: s between two counts
    """

    def __init__(self, distance: float, length: float, control_step: float):
        self.length = length
        self.control_step = control_step
        self.progress = 0.0  # m
        #: Times of the completed laps, s, interpolated within a step.
        self.lap_times: tuple[float, ...] = ()
        self._distance = distance
        self._steps = 0
        self._reached, self._reached_step = 0.0, 0

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._steps * self.control_step

    @property
    def stalled(self) -> bool:
        """Whether the car did not get `PROGRESS` m further within `PROGRESS_TIME`."""
        return (self._steps - self._reached_step) * self.control_step >= PROGRESS_TIME

    def count(self, distance: float) -> float:
        """Counts a step to ``distance`` m along the centre line; the metres that it went forward."""
        half = self.length / 2
        metres = (distance - self._distance + half) % self.length - half  # across the start line too
        if not math.isfinite(metres):  # TORCS' numbers are lost, as of a car that was placed in a wall
            metres = 0.0
        self._distance = distance
        self._steps += 1
        line = (len(self.lap_times) + 1) * self.length
        before, self.progress = self.progress, self.progress + metres
        if before < line <= self.progress:
            late = (self.progress - line) / metres * self.control_step  # s
            self.lap_times += (self.time - late - sum(self.lap_times),)
        if self.progress >= self._reached + PROGRESS:
            self._reached, self._reached_step = self.progress, self._steps
        return metres
