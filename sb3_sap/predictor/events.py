"""Events, such as a fall or a cost, which make mistakes of the actions before them."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Real
from typing import Any, Protocol

import numpy as np

from sb3_sap.common.arrays import BoolArray, Observations
from sb3_sap.common.functions import resolve
from sb3_sap.permissibility import query_labels

#: The event that is a true termination of the episode.
TERMINATED = "terminated"


class Event(Protocol):
    """Says at which of n transitions something happened that earlier actions are to blame for.

    :param obs: s, raw (never normalised) observations, (n, *obs_shape)
    :param actions: a, in the units of the environment's action space, (n, *action_shape)
    :param next_obs: s', the true next observations (never those after an automatic reset), (n, *obs_shape)
    :return: (n,) bool, True where it happened
    """

    def __call__(self, obs: Observations, actions: np.ndarray[Any, Any], next_obs: Observations, /) -> BoolArray: ...


def event_source(event: Event | str) -> Event | str:
    """What a user gave: ``"terminated"``, a key of ``info``, or a function, which is imported if it is a dotted name.

    :raise TypeError: if it is none of them
    :raise ValueError: if the function cannot be imported
    """
    if isinstance(event, str) and event and "." not in event:
        return event
    if not isinstance(event, str) and not callable(event):
        raise TypeError(
            f'`event` must be "terminated", a key of `info` such as "cost", or a function (obs, actions, next_obs) '
            f"-> (n,) bool or its dotted name, but is {event!r}."
        )
    return resolve(event, "event")


def happened(
    event: Callable[..., Any] | str,
    obs: Observations,
    actions: np.ndarray[Any, Any],
    next_obs: Observations,
    terminal: BoolArray,
    infos: list[dict[str, Any]],
) -> BoolArray:
    """Whether an event happened at each of n transitions.

    :param event: what :func:`event_source` returned
    :param obs: in the environment's layout, as for :class:`Event`; so are ``actions`` and ``next_obs``
    :param terminal: (n,) whether the episode terminated, truncations left out
    :param infos: one ``info`` of each environment
    :return: (n,) bool
    """
    if not isinstance(event, str):
        return query_labels(event, "event", obs, actions, next_obs)
    if event == TERMINATED:
        return terminal
    return np.array([_positive(info, event) for info in infos], dtype=bool)


def _positive(info: dict[str, Any], key: str) -> bool:
    if key not in info:
        raise ValueError(
            f"`event` = {key!r} is not in the environment's `info`, which must hold it at every step and has "
            f'{", ".join(map(repr, info)) or "nothing"}: give one of its keys, "terminated", or a function.'
        )
    value = info[key]
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if not isinstance(value, (Real, np.bool_)):
        raise TypeError(f"`info[{key!r}]` must be a number, above 0 where the `event` happened, but is {value!r}.")
    return float(value) > 0
