"""Random tracks: a star-shaped polygon whose corners are rounded, so that the plan closes exactly."""

from __future__ import annotations

import math

import numpy as np

from sb3_sap.envs.tracks.geometry import Segment, Track

#: Width of the road, m, as of Wheel-2.
WIDTH = 12.0
#: Minimum and maximum number of corners of the polygon.
CORNERS = (8, 14)
#: Distance from the polygon's middle to a corner, m.
CORNER_DISTANCE = (150.0, 450.0)
#: Radii of the curves, m. With a steering lock of 21° and a wheelbase of 5 m, a car can turn at 13 m.
MIN_RADIUS, MAX_RADIUS = 25.0, 120.0
#: Length that every straight keeps between the curves at its ends, m.
MIN_STRAIGHT = 10.0


def generate_track(seed: int) -> Track:
    """Return a smooth closed track that does not cross itself; the same seed gives the same track.

    Between half a kilometre and a few kilometres long, with curves both ways; it starts amid a straight.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed of a generated track must be a non-negative integer, got {seed!r}.")
    rng = np.random.default_rng(int(seed))
    while True:  # a few tries: some polygons have corners too sharp for their edges
        segments = _round_corners(_polygon(rng), rng)
        if segments is not None:
            return Track(f"random:{seed}", WIDTH, segments)


def _polygon(rng: np.random.Generator) -> list[complex]:
    count = int(rng.integers(CORNERS[0], CORNERS[1] + 1))
    angles = (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * 2 * math.pi / count
    return [complex(corner) for corner in rng.uniform(*CORNER_DISTANCE, count) * np.exp(1j * angles)]


def _round_corners(corners: list[complex], rng: np.random.Generator) -> list[Segment] | None:
    count = len(corners)
    edges = [corners[(i + 1) % count] - corners[i] for i in range(count)]  # edge i leaves corner i
    turns, radii = [], []
    for i in range(count):
        quotient = edges[i] / edges[i - 1]
        turn = math.atan2(quotient.imag, quotient.real)
        # A circle of radius r touches both edges r·tan(|turn|/2) before and after the corner.
        room = min(abs(edges[i]), abs(edges[i - 1])) / 2 - MIN_STRAIGHT / 2
        widest = min(room / math.tan(abs(turn) / 2), MAX_RADIUS)
        if widest < MIN_RADIUS:
            return None
        turns.append(turn)
        radii.append(float(rng.uniform(MIN_RADIUS, widest)))
    cuts = [radius * math.tan(abs(turn) / 2) for radius, turn in zip(radii, turns, strict=True)]
    straights = [abs(edges[i]) - cuts[i] - cuts[(i + 1) % count] for i in range(count)]
    segments = [Segment.straight(straights[0] / 2)]
    for i in range(1, count + 1):
        straight = straights[i % count] / (2 if i == count else 1)
        segments += [Segment.curve(turns[i % count], radii[i % count]), Segment.straight(straight)]
    return segments
