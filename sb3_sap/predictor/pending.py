"""Executed actions whose labels are not known yet."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np

from sb3_sap.common.arrays import BoolArray, copy_observation, rows_of, same_observation


class Step(NamedTuple):
    """A transition of one environment."""

    obs: Any  # raw
    action: np.ndarray[Any, Any]  # scaled
    next_obs: Any  # raw and true


class Due(NamedTuple):
    """An action that can be labelled now."""

    env: int
    age: int  # how many steps ago it was executed; 0: the newest
    step: Step
    later: list[Any]  # the `horizon` observations after it; the last one is repeated where the episode ended


class Pending:
    """The last actions of each environment, until ``horizon`` steps have passed or the episode has ended.

    A transition that does not go on where the last one of its environment led to begins another episode: what was
    pending is dropped, because its consequences will never be seen.

    :param horizon: number of steps, an action's own included, after which it can be labelled
    """

    def __init__(self, horizon: int):
        self.horizon = horizon
        self._steps: list[deque[Step]] = []  # of each environment, the oldest first

    def __len__(self) -> int:
        return sum(map(len, self._steps))

    def clear(self) -> None:
        """Drops everything, as the environments are reset."""
        self._steps = []

    def extend(self, obs: Any, action: np.ndarray[Any, Any], next_obs: Any) -> None:
        """Adds one transition of each of n environments.

        :param obs: raw, (n, *obs_shape)
        :param action: scaled, (n, *action_shape)
        :param next_obs: raw and true, (n, *obs_shape)
        """
        if len(self._steps) != len(action):
            self._steps = [deque() for _ in action]
        for env, steps in enumerate(self._steps):
            step = Step(*(copy_observation(rows_of(batch, env)) for batch in (obs, action, next_obs)))
            if steps and not same_observation(steps[-1].next_obs, step.obs):
                steps.clear()
            steps.append(step)

    def take(self, decided: BoolArray, done: BoolArray) -> list[Due]:
        """Removes and returns the actions that can be labelled: those whose ``horizon`` steps have passed, and more.

        :param decided: (n,) whether all actions of an environment can be labelled
        :param done: (n,) whether its episode ended, so that those that cannot be labelled now are dropped
        """
        found = []
        for env, steps in enumerate(self._steps):
            while steps and (decided[env] or len(steps) == self.horizon):
                later = [step.next_obs for step in steps]
                later += later[-1:] * (self.horizon - len(later))
                found.append(Due(env, len(steps) - 1, steps.popleft(), later))
            if done[env]:
                steps.clear()
        return found
