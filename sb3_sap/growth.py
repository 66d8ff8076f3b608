"""Work that is done ever more rarely: each time that a count has grown by a given share."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any


def due(growth: float, before: int, now: int, one_of: int = 1, apart: float = math.inf) -> int:
    """How often work is due after the count ``before``, up to ``now``.

    At every count at first, then, once a share of ``growth`` is more than one, as their logarithm.

    :param growth: the share, from 0 (at every count) to below 1
    :param one_of: of so many times one is left
    :param apart: so many counts, at most, lie between two times
    """

    def until(count: int) -> int:
        growing = min(count, apart / growth) if growth else count
        times = growing if growth * growing <= 1 else (1 + math.log(growth * growing)) / growth
        return int(times + (count - growing) / apart) // one_of

    return until(now) - until(before)


def check_growth(model: Any, name: str) -> None:
    """Refuses a setting of a model that is no such share."""
    value = getattr(model, name)
    if not (isinstance(value, Real) and 0 <= float(value) < 1):
        raise ValueError(f"`{name}` is a share from 0 to below 1, but is {value!r}.")
