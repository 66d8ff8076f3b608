"""Settings that may be schedules, and how RL Zoo writes one."""

from __future__ import annotations

import re
from numbers import Real
from typing import Any

from stable_baselines3.common.utils import LinearSchedule

#: RL Zoo's notation for a schedule that falls linearly to 0.
LINEAR = r"lin_(?P<start>\d+\.?\d*(e-?\d+)?)"
#: Ours for one that gets there earlier.
_EARLIER = LINEAR + r"(_(?P<share>0?\.\d*[1-9]\d*))?"


def as_schedule(value: Any, argument: str) -> Any:
    """Returns a number or schedule unchanged, and for RL Zoo's ``"lin_<number>"`` a schedule from that number to 0.

    ``"lin_1.0_0.5"`` falls from 1 to 0 within the first half of the training.

    :param argument: the name of the constructor argument, for the error message
    """
    if isinstance(value, Real) or callable(value) or (value is None and argument == "actor_learning_rate"):
        return value
    written = re.fullmatch(_EARLIER, value) if isinstance(value, str) else None
    if written is None:
        raise ValueError(f'`{argument}` must be a number, a schedule or "lin_<number>", but is {value!r}.')
    return LinearSchedule(float(written["start"]), 0.0, float(written["share"] or 1.0))
