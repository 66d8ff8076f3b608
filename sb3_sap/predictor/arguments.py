"""Checks of what the predictor E is built with."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import torch as th
from gymnasium import spaces

from sb3_sap.common.errors import is_number


def optimizer_named(optimizer_class: type[th.optim.Optimizer] | str) -> type[th.optim.Optimizer]:
    """A class of ``torch.optim`` by its name; a class remains as it is.

    :raise ValueError: if there is none of that name
    """
    if not isinstance(optimizer_class, str):
        return optimizer_class
    found = getattr(th.optim, optimizer_class, None)
    if not (isinstance(found, type) and issubclass(found, th.optim.Optimizer)):
        raise ValueError(f"`optimizer_class` = {optimizer_class!r} names no optimizer of torch.optim, such as 'Adam'.")
    return found


def checked_output_per_action(value: Any, space: spaces.Space[Any], parts: bool) -> bool:
    """:raise ValueError: with one sentence, if E cannot have an output for each action"""
    if value not in (True, False):
        raise ValueError(f"`output_per_action` must be True or False, but is {value!r}.")
    if value and (parts or not isinstance(space, spaces.Discrete)):
        what = "`action_parts`" if parts else f"the action space {space}"
        raise ValueError(f"`output_per_action` is for Discrete actions without parts, not for {what}: leave it out.")
    return bool(value)


def check_arguments(net_arch: Any, batch_size: Any, learning_rate: Any, threshold: Any) -> None:
    """:raise ValueError: with one sentence, for a value that E cannot have"""
    if not (is_number(threshold) and 0 < threshold < 1):
        raise ValueError(f"`threshold` of the predictor must lie between 0 and 1, but is {threshold!r}.")
    if not isinstance(net_arch, (list, tuple)) or not all(isinstance(n, Integral) and int(n) > 0 for n in net_arch):
        raise ValueError(f"`net_arch` must be a list of the widths of hidden layers, but is {net_arch!r}.")
    if not (isinstance(batch_size, Integral) and int(batch_size) > 0):
        raise ValueError(f"`batch_size` must be a whole number of at least 1, but is {batch_size!r}.")
    if not (isinstance(learning_rate, Real) and float(learning_rate) >= 0):
        raise ValueError(f"`learning_rate` of the predictor must be a number of at least 0, but is {learning_rate!r}.")
