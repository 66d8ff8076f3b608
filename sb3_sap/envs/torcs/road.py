"""The road as TORCS built it: a ring of segments, and where along it a place lies."""

from __future__ import annotations

import tempfile
from bisect import bisect_right
from typing import Any, NamedTuple

from sb3_sap.envs.torcs.libraries import Private, reading
from sb3_sap.envs.torcs.structures import STRAIGHT, TrackSegment, TrackStructure


class Segment(NamedTuple):
    """A segment of the road."""

    address: int
    straight: bool
    from_start: float  # m
    radius: float  # m, 0 on straights
    width: float  # m

    def along(self, to_start: float) -> float:
        """Converts TORCS' measure from the segment's start (m on straights, rad in curves) to m."""
        return to_start if self.straight else to_start * self.radius

    def to_start(self, along: float) -> float:
        """Converts m from the segment's start to TORCS' measure."""
        return along if self.straight else along / self.radius


class Road:
    """A track, built by one copy of TORCS' library.

    :param library: the copy; the road lives as long as its track is not shut down
    :param document: a clean track file
    """

    def __init__(self, library: Private, document: bytes):
        with tempfile.NamedTemporaryFile(suffix=".xml") as file:
            file.write(document)
            file.flush()
            with reading():
                address = library.build_track(file.name.encode())
        self.structure: Any = TrackStructure.from_address(address) if address else None
        if self.structure is None or not self.structure.last_segment:
            raise ValueError("TORCS builds no road from the track file: compare it with one that TORCS ships.")
        self.length: float = self.structure.length
        self.segments = self._read_segments()
        self.at_address = {segment.address: segment for segment in self.segments}
        self._starts = [segment.from_start for segment in self.segments]

    def _read_segments(self) -> list[Segment]:
        segments = []
        address = TrackSegment.from_address(self.structure.last_segment).next
        for _ in range(self.structure.n_segments):
            found = TrackSegment.from_address(address)
            straight = found.type == STRAIGHT
            segments.append(
                Segment(address, straight, found.from_start, 0.0 if straight else found.radius, found.width)
            )
            address = found.next
        return segments

    def segment(self, distance: float) -> Segment:
        """The segment at ``distance`` m along the centre line, on the first lap."""
        return self.segments[max(bisect_right(self._starts, distance) - 1, 0)]
