"""Geometric update schedule: an update each time that a count has grown by a given fraction."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

#: Labels that count more than later ones where fits are in proportion to what is new, and how much more.
EARLY_LABELS, EARLY_WEIGHT = 2_000, 8


def due(growth: float, before: int, now: int, every: int = 1, max_gap: float = math.inf) -> int:
    """The number of updates due after the count ``before``, up to ``now``.

    At first an update is due at every count. Once ``growth`` times the count exceeds one, the gaps between updates are
    that long, and the number of updates grows as the logarithm of the count.

    :param growth: the fraction, from 0 (at every count) to below 1
    :param every: keep only every n-th update
    :param max_gap: maximum gap between two updates, in counts
    """

    def total(count: int) -> int:
        # Up to this count the gaps grow; after it, they are `max_gap`.
        growing = min(count, max_gap / growth) if growth else count
        updates = growing if growth * growing <= 1 else (1 + math.log(growth * growing)) / growth
        return int(updates + (count - growing) / max_gap) // every

    return total(now) - total(before)


def weighted_labels(n: int) -> int:
    """What the first ``n`` labels count for, where fits are in proportion to what is new.

    The first :data:`EARLY_LABELS` count :data:`EARLY_WEIGHT` times: they have to teach E from nothing, and however long
    the training is, their fits take a second or so.
    """
    return n + (EARLY_WEIGHT - 1) * min(n, EARLY_LABELS)


def check_growth(model: Any, name: str) -> None:
    """Raises a ``ValueError`` for a setting of a model that is not a fraction from 0 to below 1."""
    value = getattr(model, name)
    if not (isinstance(value, Real) and 0 <= float(value) < 1):
        raise ValueError(f"`{name}` is a fraction from 0 to below 1, but is {value!r}.")
