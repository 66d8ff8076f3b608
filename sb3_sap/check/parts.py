"""The label of one part of the action, as if it were that of the whole."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_sap.common.arrays import BoolArray, Observations
from sb3_sap.permissibility import APFunction, labels_from_infos, query_labels


class OfPart:
    """The AP function of one part.

    :param function: of all parts, f(s, a | s') -> (n, k)
    :param names: of the k parts
    :param number: which of them
    """

    def __init__(self, function: APFunction, names: tuple[str, ...], number: int):
        self.function, self.names, self.number = function, names, number

    def __call__(self, obs: Observations, actions: np.ndarray[Any, Any], next_obs: Observations) -> BoolArray:
        return query_labels(self.function, "ap_function", obs, actions, next_obs, parts=self.names)[:, self.number]


class InfoOfPart(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose ``info["permissible"]`` is that of one part. The parameters are those of `OfPart`."""

    def __init__(self, env: gym.Env[Any, Any], names: tuple[str, ...], number: int):
        super().__init__(env)
        self.names, self.number = names, number

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        *rest, info = self.env.step(action)
        label = bool(labels_from_infos([info], self.names)[0, self.number])
        return *rest, {**info, "permissible": label}
