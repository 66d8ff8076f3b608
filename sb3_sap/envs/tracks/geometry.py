"""The plan of a track: a list of segments, laid end to end as straight pieces and circular arcs.

x points east, y north, headings turn anticlockwise from east; "left" is positive, for offsets and for curvature.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

#: Largest turn of a piece, rad. Longer arcs are laid as several pieces, so that places along a piece are unambiguous.
MAX_PIECE_TURN = math.pi / 2


class Segment(NamedTuple):
    """One segment as TORCS' track files describe it.

    A straight has no turn. A curve whose end radius differs from its radius is laid as ``steps`` arcs of equal
    length, whose radius changes linearly from the one to the other.
    """

    length: float  # m along the centre line; of a curve: mean radius times |turn|
    turn: float = 0.0  # rad, positive to the left
    radius: float = math.inf  # m
    end_radius: float = math.inf  # m
    steps: int = 1

    @classmethod
    def straight(cls, length: float, steps: int = 1) -> Segment:
        """Return a straight of ``length`` metres."""
        return cls(length, steps=steps)

    @classmethod
    def curve(cls, turn: float, radius: float, end_radius: float | None = None, steps: int = 1) -> Segment:
        """Return a curve through ``turn`` rad (positive to the left) with its radii in metres."""
        end_radius = radius if end_radius is None else end_radius
        return cls((radius + end_radius) / 2 * abs(turn), turn, radius, end_radius, steps)

    def arcs(self) -> list[tuple[float, float]]:
        """Return the (length m, curvature 1/m) of the pieces that the segment is laid with."""
        if self.radius == self.end_radius:
            curvature = math.copysign(1 / self.radius, self.turn) if self.turn else 0.0
            count = max(1, math.ceil(abs(self.turn) / MAX_PIECE_TURN))
            return [(self.length / count, curvature)] * count
        change = (self.end_radius - self.radius) / max(self.steps - 1, 1)
        radii = [self.radius + change * step for step in range(self.steps)]
        length = abs(self.turn) / sum(1 / radius for radius in radii)  # equal lengths that add up to the turn
        return [(length, math.copysign(1 / radius, self.turn)) for radius in radii]


class Piece(NamedTuple):
    """A straight or an arc in its place: where it starts, and how it bends."""

    start: float  # m along the centre line
    length: float  # m
    x: float  # m
    y: float  # m
    heading: float  # rad, at the start
    curvature: float  # 1/m, positive to the left

    def point(self, along: float, lateral: float = 0.0) -> tuple[float, float, float]:
        """Return x (m), y (m) and heading (rad) ``along`` m after the start, ``lateral`` m left of the centre line."""
        heading = self.heading + self.curvature * along
        if self.curvature:
            x = self.x + (math.sin(heading) - math.sin(self.heading)) / self.curvature
            y = self.y - (math.cos(heading) - math.cos(self.heading)) / self.curvature
        else:
            x, y = self.x + along * math.cos(heading), self.y + along * math.sin(heading)
        return x - lateral * math.sin(heading), y + lateral * math.cos(heading), heading

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Return (along, lateral) in metres of a point: the inverse of `point`. ``along`` may lie outside the piece."""
        dx, dy = x - self.x, y - self.y
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        forward, left = cos * dx + sin * dy, cos * dy - sin * dx
        if not self.curvature:
            return forward, left
        radius = 1 / self.curvature  # signed: the centre lies this far to the left
        side = math.copysign(1.0, radius)
        turned = math.atan2(side * forward, side * (radius - left))
        return turned * radius, radius - side * math.hypot(forward, radius - left)


class Track:
    """A closed road of constant width.

    :param name: how the track is called in messages and tables
    :param width: m, from edge to edge
    :param segments: at least one, in driving order; the first begins at the start line
    """

    def __init__(self, name: str, width: float, segments: Sequence[Segment]) -> None:
        if not (math.isfinite(width) and width > 0):
            raise ValueError(f"width of track {name!r} must be a positive number of metres, got {width!r}.")
        if not segments:
            raise ValueError(f"segments of track {name!r} must hold at least one segment, got none.")
        self.name = name
        self.width = width
        self.segments = tuple(segments)
        self.pieces = _lay(self.segments)
        self.length: float = self.pieces[-1].start + self.pieces[-1].length
        self._starts = [piece.start for piece in self.pieces]

    def __repr__(self) -> str:
        return f"Track({self.name!r}, length={self.length:.2f} m, width={self.width:g} m)"

    @property
    def min_radius(self) -> float:
        """Radius (m) of the tightest curve."""
        return min(min(segment.radius, segment.end_radius) for segment in self.segments)

    @property
    def gap(self) -> float:
        """How far (m) the end of the last piece lies from the start line; 0 for a perfectly closed plan."""
        x, y, _ = self.pieces[-1].point(self.pieces[-1].length)
        return math.hypot(x - self.pieces[0].x, y - self.pieces[0].y)

    def piece_at(self, distance: float) -> int:
        """Return the index of the piece at ``distance`` m from the start line (any lap)."""
        return bisect_right(self._starts, distance % self.length) - 1

    def position(self, distance: float, lateral: float = 0.0) -> tuple[float, float, float]:
        """Return x (m), y (m) and road heading (rad) at ``distance`` m, ``lateral`` m left of the centre line."""
        piece = self.pieces[self.piece_at(distance)]
        return piece.point(distance % self.length - piece.start, lateral)

    def locate(self, x: float, y: float, piece: int) -> tuple[float, float, float, int]:
        """Find a point from the piece where it, or the car that it belongs to, was last seen.

        Following the road is not only fast: where a track crosses over itself, the nearest piece is the wrong one.

        :return: distance (m, in [0, length)), lateral offset (m), road heading (rad) and the new piece's index
        """
        along, lateral = self.pieces[piece].project(x, y)
        step = 1 if along > 0 else -1
        for _ in self.pieces:
            beyond = along >= self.pieces[piece].length if step > 0 else along < 0
            if not beyond:
                break
            piece = (piece + step) % len(self.pieces)
            along, lateral = self.pieces[piece].project(x, y)
        here = self.pieces[piece]
        along = min(max(along, 0.0), here.length)  # the outside of a kink, such as the gap at the start line
        return (here.start + along) % self.length, lateral, here.heading + here.curvature * along, piece


def _lay(segments: Sequence[Segment]) -> tuple[Piece, ...]:
    pieces = [Piece(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)]
    for length, curvature in (arc for segment in segments for arc in segment.arcs()):
        last = pieces[-1]
        pieces.append(Piece(last.start + last.length, length, *last.point(last.length), curvature))
    return tuple(pieces[1:])
