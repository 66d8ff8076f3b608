"""Dimensions of a finite action that are masked together, and the distribution that is a product over such blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import MultiCategoricalDistribution

from sb3_sap.common.arrays import BoolArray
from sb3_sap.guidance.masks import joint_masks
from sb3_sap.onpolicy.masks import log_probs_of_dimensions, masked_categorical


@dataclass(frozen=True)
class Block:
    """Dimensions of an action, with every combination of their choices.

    :param dimensions: their numbers
    :param sizes: the number of choices in each
    :param choices: (m, len(dimensions)) the combinations, the last dimension fastest
    """

    dimensions: list[int]
    sizes: list[int]
    choices: th.Tensor

    @classmethod
    def of(cls, dimensions: Sequence[int], sizes: list[int], device: th.device) -> Block:
        """:param sizes: the number of choices in each dimension of the whole action"""
        own = [sizes[dimension] for dimension in dimensions]
        choices = np.stack(np.unravel_index(np.arange(math.prod(own)), own), axis=1)
        return cls(list(dimensions), own, th.as_tensor(choices, device=device))

    def __len__(self) -> int:
        return len(self.choices)

    def index_of(self, actions: th.Tensor) -> th.Tensor:
        """(n,) the combinations that (n, action_dim) actions have chosen."""
        index = th.zeros(len(actions), dtype=th.long, device=actions.device)
        for dimension, size in zip(self.dimensions, self.sizes, strict=True):
            index = index * size + actions[:, dimension].long()
        return index

    def log_probs(self, of_dimensions: list[th.Tensor]) -> th.Tensor:
        """(n, m) log-probabilities of the combinations, from those of each dimension of the action, (n, size)."""
        if len(self.dimensions) == 1:
            return of_dimensions[self.dimensions[0]]
        columns = zip(self.dimensions, self.choices.unbind(dim=1), strict=True)
        return th.stack([of_dimensions[dimension][:, column] for dimension, column in columns]).sum(dim=0)

    def known(self, masks: BoolArray, sizes: list[int]) -> BoolArray:
        """(n, m) from the known masks of all dimensions, (n, sum of sizes)."""
        ends = np.cumsum(sizes)
        columns = [masks[:, ends[dimension] - sizes[dimension] : ends[dimension]] for dimension in self.dimensions]
        return joint_masks(np.concatenate(columns, axis=1), self.sizes)


class MaskedProduct(MultiCategoricalDistribution):
    """A policy's distribution, each block of dimensions given that its combination is permitted.

    With a mask for each dimension it gives what sb3-contrib's ``MaskablePPO`` gives, to the bit.

    :param distribution: of the policy in n states
    :param blocks: which together have every dimension once
    :param masks: (n, m) bool for each block, with at least one True in each row
    :param space: the action space
    """

    def __init__(self, distribution: Any, blocks: list[Block], masks: list[th.Tensor], space: spaces.Space[Any]):
        super().__init__([len(block) for block in blocks])
        of_dimensions = log_probs_of_dimensions(distribution)
        pairs = zip(blocks, masks, strict=True)
        self.distribution = [masked_categorical(block.log_probs(of_dimensions), mask) for block, mask in pairs]
        self.blocks, self.space = blocks, space

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """(n,) of (n, action_dim) actions."""
        pairs = zip(self.distribution, self.blocks, strict=True)
        each = [one.log_prob(block.index_of(actions)) for one, block in pairs]  # type: ignore[no-untyped-call]
        return th.stack(each, dim=1).sum(dim=1)

    def sample(self) -> th.Tensor:
        """(n, action_dim)."""
        return self._action([one.sample() for one in self.distribution])  # type: ignore[no-untyped-call]

    def mode(self) -> th.Tensor:
        """(n, action_dim), of each block the most probable combination that is permitted."""
        return self._action([th.argmax(one.probs, dim=1) for one in self.distribution])

    def _action(self, indices: list[th.Tensor]) -> th.Tensor:
        columns: dict[int, th.Tensor] = {}
        for block, index in zip(self.blocks, indices, strict=True):
            columns |= zip(block.dimensions, block.choices[index].unbind(dim=1), strict=True)
        return in_type_of(self.space, th.stack([columns[dimension] for dimension in range(len(columns))], dim=1))


def in_type_of(space: spaces.Space[Any], actions: th.Tensor) -> th.Tensor:
    """Whole-number actions in the type that SB3's distributions have for a space."""
    return actions.float() if isinstance(space, spaces.MultiBinary) else actions


def permitted_share(distribution: Any, blocks: list[Block], masks: list[th.Tensor]) -> th.Tensor:
    """(n,) log of the probability that a policy gives to what the masks of the blocks permit."""
    of_dimensions = log_probs_of_dimensions(distribution)
    pairs = zip(blocks, masks, strict=True)
    each = [block.log_probs(of_dimensions).masked_fill(~mask, -th.inf).logsumexp(dim=1) for block, mask in pairs]
    return th.stack(each).sum(dim=0)
