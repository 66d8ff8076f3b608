"""Checks of the user's arguments, and the wording of their errors."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any


def is_number(value: object) -> bool:
    """Whether a setting is a real number, whatever its annotation promises."""
    return isinstance(value, Real)


def nearest(value: object, known: Iterable[str], n: int = 1, cutoff: float = 0.6) -> str:
    """The end of a sentence that calls ``value`` unknown: the valid names nearest to it, or all of them.

    :param n: maximum number of names that are suggested
    :param cutoff: similarity from 0 to 1 that a suggestion must have
    """
    names = list(known)
    near = difflib.get_close_matches(str(value), names, n, cutoff)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else f"choose one of {', '.join(map(repr, names))}."


def check_at_least(model: Any, **minima: int) -> None:
    """Raises a ``ValueError`` for a setting of a model that is not a whole number or is below its minimum."""
    for name, minimum in minima.items():
        value = getattr(model, name)
        if not isinstance(value, Integral) or value < minimum:
            raise ValueError(f"`{name}` must be a whole number of at least {minimum}, but is {value!r}.")
