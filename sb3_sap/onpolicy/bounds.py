"""Continuous actions in the units of a policy, and scaled to [-1, 1] for E."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces


class Bounds:
    """Scales actions of a policy.

    :param space: of the actions
    :param squashed: whether the policy's actions are scaled to [-1, 1] already
    :param device: of the policy
    """

    def __init__(self, space: spaces.Space[Any], squashed: bool, device: th.device):
        assert isinstance(space, spaces.Box)
        self.squashed = squashed
        self._low, self._high = (th.as_tensor(bound.reshape(-1), device=device) for bound in (space.low, space.high))
        self._scaled = bool((space.low == -1).all() and (space.high == 1).all())

    def executed(self, actions: th.Tensor, straight: bool = False) -> th.Tensor:
        """(n, action_dim) what is executed of a policy's actions, scaled to [-1, 1].

        :param straight: what is outside the bounds is executed at the bound, but its gradient is passed on as if it
            were not, so that it may lead the action back
        """
        if self.squashed:
            return actions
        scaled = actions
        if not self._scaled:
            low, high = self._low.to(actions.dtype), self._high.to(actions.dtype)
            scaled = 2 * (actions - low) / (high - low) - 1
        clipped = scaled.clamp(-1, 1)
        return scaled + (clipped - scaled).detach() if straight else clipped

    def of_policy(self, scaled: th.Tensor) -> th.Tensor:
        """(..., action_dim) scaled actions in the units of the policy."""
        if self.squashed:
            return scaled
        low, high = self._low.to(scaled.dtype), self._high.to(scaled.dtype)
        return low + (scaled + 1) / 2 * (high - low)
