"""The hand-made constraints of section 5.1: the interval of actions that a user's function allows now."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from sb3_sap.common.arrays import copy_observation


class ActionConstraint(Protocol):
    """The interval of actions that is allowed in one environment.

    :param obs: raw observation now, (*obs_shape)
    :param previous_obs: raw observation one step before, in the same episode
    :param last_action: the action executed there, in the environment's units, (*action_shape)
    :return: (low, high), each (*action_shape), in the environment's units
    """

    def __call__(self, obs: Any, previous_obs: Any, last_action: Any, /) -> tuple[Any, Any]: ...


def query_constraint(constraint: ActionConstraint, shape: tuple[int, ...], *situation: Any) -> tuple[Any, Any]:
    """Calls a user's constraint and checks what it returns.

    :param shape: of one action
    :param situation: obs, previous_obs and last_action, as the constraint takes them
    :raise RuntimeError: if the constraint raises an error
    :raise ValueError: if it does not return an interval of such actions
    """
    try:
        answer = constraint(*map(copy_observation, situation))
    except Exception as error:
        raise RuntimeError(
            f"`constraint` raised {type(error).__name__}: {error}. It is called with (obs, previous_obs, last_action) "
            f"of one environment; here the action has shape {shape}."
        ) from error
    try:
        low, high = (np.broadcast_to(bound, shape) for bound in answer)
        if {low.dtype.kind, high.dtype.kind} - set("iuf"):
            raise TypeError("no numbers")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`constraint` must return (low, high), each of the action's shape {shape}, but gave {answer!r}."
        ) from error
    return low, high
