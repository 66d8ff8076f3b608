"""The distribution of a policy over finitely many actions, restricted to those that are permitted."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from torch.distributions import Categorical
from torch.nn import functional as F

from sb3_sap.common.spaces import sizes_of

#: Logit of an action that is not permitted, as in sb3-contrib's ``MaskablePPO``: its probability is exactly 0, and
#: unlike an infinite one it brings no NaN into gradients and Kullback-Leibler divergences.
REJECTED_LOGIT = -1e8


def log_probs_of_dimensions(distribution: Distribution) -> list[th.Tensor]:
    """(n, size) log-probabilities of the choices in each dimension, which in SB3's policies are independent.

    :raise TypeError: for a distribution that is none of SB3's over finite actions
    """
    if isinstance(distribution, CategoricalDistribution):
        return [distribution.distribution.logits]
    if isinstance(distribution, MultiCategoricalDistribution):
        return [one.logits for one in distribution.distribution]
    if isinstance(distribution, BernoulliDistribution):
        logits = distribution.distribution.logits
        return list(th.stack([F.logsigmoid(-logits), F.logsigmoid(logits)], dim=2).unbind(dim=1))
    raise TypeError(
        f"The policy's {type(distribution).__name__} cannot be masked: use a policy of SB3's distributions."
    )


def joint_log_probs(distribution: Distribution, actions: th.Tensor) -> th.Tensor:
    """(n, k) log-probabilities of k joint actions in n states.

    :param actions: (k, action_dim), those of :func:`~sb3_sap.common.spaces.joint_actions`
    """
    of_dimensions = log_probs_of_dimensions(distribution)
    if len(of_dimensions) == 1:
        return of_dimensions[0]
    columns = zip(of_dimensions, actions.long().unbind(dim=1), strict=True)
    return th.stack([one[:, column] for one, column in columns]).sum(dim=0)


def masked_categorical(log_probs: th.Tensor, mask: th.Tensor) -> Categorical:
    """(n, k) log-probabilities, given what (n, k) masks permit."""
    rejected = th.tensor(REJECTED_LOGIT, dtype=log_probs.dtype, device=log_probs.device)
    # The policy's own distribution has checked its logits.
    return Categorical(logits=th.where(mask, log_probs, rejected), validate_args=False)


class MaskedDistribution(CategoricalDistribution):
    """A policy's distribution over joint actions, given that the action is permitted.

    ``Discrete`` gives what sb3-contrib's ``MaskableCategorical`` gives, to the bit. For several dimensions the mask
    is of combinations, which no product of masked dimensions could express.

    :param log_probs: (n, k) of the policy
    :param mask: (n, k) bool, with at least one True in each row
    :param space: the finite action space, of k actions
    :param actions: (k, action_dim), those of :func:`~sb3_sap.common.spaces.joint_actions`
    """

    def __init__(self, log_probs: th.Tensor, mask: th.Tensor, space: spaces.Space[Any], actions: th.Tensor):
        super().__init__(len(actions))
        self.distribution = masked_categorical(log_probs, mask)
        self.space = space
        self.actions = actions

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """(n,) of (n, *action_shape) actions."""
        return self.distribution.log_prob(index_of(self.space, actions))  # type: ignore[no-any-return, no-untyped-call]

    def sample(self) -> th.Tensor:
        """(n, *action_shape)."""
        return self._action(self.distribution.sample())  # type: ignore[no-untyped-call]

    def mode(self) -> th.Tensor:
        """(n, *action_shape), the most probable joint action that is permitted."""
        return self._action(th.argmax(self.distribution.probs, dim=1))

    def _action(self, index: th.Tensor) -> th.Tensor:
        if isinstance(self.space, spaces.Discrete):
            return index
        actions = self.actions[index]
        return actions.float() if isinstance(self.space, spaces.MultiBinary) else actions  # as SB3's distributions do


def index_of(space: spaces.Space[Any], actions: th.Tensor) -> th.Tensor:
    """(n,) the rows of :func:`~sb3_sap.common.spaces.joint_actions` that hold (n, *action_shape) actions."""
    if isinstance(space, spaces.Discrete):
        return actions.long().flatten()
    sizes = sizes_of(space)
    strides = [int(np.prod(sizes[i + 1 :])) for i in range(len(sizes))]
    return (actions.long() * th.as_tensor(strides, device=actions.device)).sum(dim=1)
