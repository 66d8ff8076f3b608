"""Type-2 permissibility: actions that the state alone rules out, before they are executed."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from sb3_sap.common.arrays import BoolArray, Observations


class PermissibleActions(Protocol):
    """Which actions of a batch may be executed, as a function of the state alone.

    :param obs: raw (never normalised) observations, (n, *obs_shape)
    :param actions: in the units of the environment's action space, (n, *action_shape)
    :return: (n,) bool
    """

    def __call__(self, obs: Observations, actions: np.ndarray[Any, Any], /) -> BoolArray: ...
