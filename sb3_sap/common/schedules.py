"""Settings that may be schedules, and how RL Zoo writes one."""

from __future__ import annotations

import re
from numbers import Real
from typing import Any

from stable_baselines3.common.utils import LinearSchedule

#: RL Zoo's notation for a schedule that falls linearly to 0.
LINEAR = r"lin_\d+\.?\d*(e-?\d+)?"


def as_schedule(value: Any, argument: str) -> Any:
    """Returns a number or schedule unchanged, and for RL Zoo's ``"lin_<number>"`` a schedule from that number to 0.

    :param argument: the name of the constructor argument, for the error message
    """
    if isinstance(value, Real) or callable(value) or (value is None and argument == "actor_learning_rate"):
        return value
    if not (isinstance(value, str) and re.fullmatch(LINEAR, value)):
        raise ValueError(f'`{argument}` must be a number, a schedule or "lin_<number>", but is {value!r}.')
    return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
