"""An environment whose permissible actions differ from state to state, by a random mask."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_sap.common.spaces import sizes_of


class Masked(gym.Env[Any, Any]):
    """The observation encodes the mask, so that :func:`allowed` can read it; episodes end by either way.

    :param action_space: a finite one
    :param joint: whether masks are of combinations
    :param as_info: whether the mask is put into ``info``, instead of the method ``action_masks``
    """

    def __init__(self, action_space: spaces.Space[Any] | None = None, joint: bool = False, as_info: bool = False):
        self.action_space = spaces.Discrete(5) if action_space is None else action_space
        self.sizes = sizes_of(self.action_space)
        self.shape = tuple(self.sizes) if joint else (sum(self.sizes),)
        self.observation_space = spaces.Box(-np.inf, np.inf, (1 + int(np.prod(self.shape)),), np.float32)
        self.joint, self.as_info = joint, as_info
        self.steps = self.illegal = 0
        if not as_info:
            self.action_masks = lambda: self.mask

    def _obs(self) -> Any:
        self.mask = self.np_random.random(self.shape) < 0.4
        start = 0
        for size in () if self.joint else self.sizes:  # a choice in each dimension
            self.mask[start + self.np_random.integers(size)] = True
            start += size
        if self.joint:
            self.mask.flat[self.np_random.integers(self.mask.size)] = True
        return np.float32([self.np_random.random(), *self.mask.ravel()])

    def _info(self) -> dict[str, Any]:
        return {"action_mask": self.mask} if self.as_info else {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._obs(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        chosen = np.asarray(action).reshape(-1).astype(int)
        if self.joint:
            legal = self.mask[tuple(chosen)]
        else:
            starts = np.cumsum([0, *self.sizes[:-1]])
            legal = self.mask[starts + chosen].all()
        self.steps += 1
        self.illegal += not legal
        # What is forbidden would pay, so that an unmasked target's maximum prefers it.
        reward = float(chosen.sum()) + (0 if legal else 100)
        return self._obs(), reward, self.np_random.random() < 0.1, self.np_random.random() < 0.1, self._info()


def allowed(obs: Any, actions: Any) -> Any:
    """``permissible_actions`` of a :class:`Masked` with Discrete(5)."""
    return obs[np.arange(len(actions)), 1 + np.asarray(actions, dtype=int)] > 0.5
