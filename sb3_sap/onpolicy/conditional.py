"""Masks of a finite action with too many combinations for all of them to be judged: one block after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution, MultiCategoricalDistribution
from torch.distributions import Categorical

from sb3_sap.common.arrays import BoolArray, rows_of
from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.onpolicy.blocks import Block, MaskedProduct, in_type_of, permitted_share
from sb3_sap.onpolicy.enumerated import PAIRS_AT_ONCE, within
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.masks import log_probs_of_dimensions, masked_categorical
from sb3_sap.onpolicy.states import Remembered, keys_of, keys_with
from sb3_sap.predictor.pairs import judge

#: Maximum number of combinations of a block of dimensions, each of which E judges.
BLOCK = 256


class ConditionalGuide(Guide):
    """Draws one block of dimensions after the other, each given the earlier ones, from what E permits.

    E judges whole actions. A combination of a block is permitted if E permits the action with the earlier blocks as
    they were drawn and the later ones as the *completion* has them, which is the policy's most probable action within
    the known masks, when the state was first met in the rollout. Where E permits no combination of a block, all are.
    The probability of an action is the product of the blocks' conditional probabilities, which sum to one exactly.

    Once a combination was permitted, the completion itself is permitted in each later block, so that the action is
    permitted in the end: E rejects the executed action only if it rejected every combination of every block. But an
    action that E permits may have probability 0, if E rejects its first blocks beside the completion.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.blocks = consecutive_blocks(self.known.sizes, self.device)
        self._completions, self._masks = Remembered(), Remembered()

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        if executed is None:
            return ConditionalDistribution(self, obs, distribution)
        masks = self.masks_of(obs, distribution, executed)
        for block, mask in zip(self.blocks, masks, strict=True):
            mask[th.arange(len(mask), device=mask.device), block.index_of(executed)] = True
        return MaskedProduct(distribution, self.blocks, masks, self.space)

    def losses(self, obs: Any, distribution: Distribution) -> th.Tensor:
        """−log of the permitted probability of each block beside the completion, summed over the blocks."""
        completion = self._completion(keys_of(obs), distribution)
        return -permitted_share(distribution, self.blocks, self.masks_of(obs, distribution, completion))

    def masks_of(self, obs: Any, distribution: Distribution, actions: th.Tensor) -> list[th.Tensor]:
        """(n, m) bool for each block, what is permitted in it given the earlier blocks of (n, action_dim) actions."""
        states = keys_of(obs)

        def find(rows: list[int]) -> BoolArray:
            completion, known = self._completion(states, distribution)[rows], self.known.of(states)
            _, masks = self._walk(
                rows_of(obs, rows),
                completion,
                None if known is None else known[rows],
                lambda number, mask: self.blocks[number].index_of(actions[rows]),
            )
            return th.cat(masks, dim=1).cpu().numpy()

        found = self._masks.rows(keys_with(states, actions), find)
        ends = np.cumsum([len(block) for block in self.blocks])
        return [th.as_tensor(mask, device=self.device) for mask in np.split(found, ends[:-1], axis=1)]

    def draw(self, obs: Any, distribution: Distribution, choose: Callable[[Categorical], th.Tensor]) -> th.Tensor:
        """(n, action_dim) actions, whose masks are kept for the update.

        :param choose: (n,) a combination of each of n distributions over those of a block
        """
        states, of_dimensions = keys_of(obs), log_probs_of_dimensions(distribution)
        log_probs = [block.log_probs(of_dimensions) for block in self.blocks]
        actions, masks = self._walk(
            obs,
            self._completion(states, distribution),
            self.known.of(states),
            lambda number, mask: choose(masked_categorical(log_probs[number], mask)),
        )
        with th.no_grad():
            self.record("sap/rejection_rate", 1 - permitted_share(distribution, self.blocks, masks).exp())
        self._masks.rows(keys_with(states, actions), lambda new: th.cat(masks, dim=1)[new].cpu().numpy())
        return actions

    @th.no_grad()
    @flush_denormals()
    def _walk(
        self,
        obs: Any,
        completion: th.Tensor,
        known: BoolArray | None,
        choose: Callable[[int, th.Tensor], th.Tensor],
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """Actions of n states, one block after the other, and the masks on the way.

        :param choose: (n,) the combinations of a block, of its number and its mask
        """
        assert self.predictor is not None
        features, actions, masks = self.predictor.features(obs), completion.clone(), []
        for number, block in enumerate(self.blocks):
            permitted = self._permits(features, actions, block)
            of_dimensions = None if known is None else block.known(known, self.known.sizes)
            masks.append(th.as_tensor(within(permitted, of_dimensions), device=self.device))
            actions[:, block.dimensions] = block.choices[choose(number, masks[-1])]
        return actions, masks

    def _permits(self, features: th.Tensor, actions: th.Tensor, block: Block) -> BoolArray:
        """(n, m) bool, which of the combinations of a block E permits in n actions."""
        assert self.predictor is not None
        m, at_once, found = len(block), max(1, PAIRS_AT_ONCE // len(block)), []
        for some_features, some in zip(th.split(features, at_once), th.split(actions, at_once), strict=True):
            varied = some[:, None].repeat(1, m, 1)
            varied[:, :, block.dimensions] = block.choices
            found.append(judge(self.predictor, some_features, varied) > 0)
        return th.cat(found).cpu().numpy()

    def _completion(self, states: list[bytes], distribution: Distribution) -> th.Tensor:
        """(n, action_dim) the policy's most probable known permissible action in n states, when each was first met."""

        def find(rows: list[int]) -> np.ndarray[Any, Any]:
            of_dimensions, known = [one[rows] for one in log_probs_of_dimensions(distribution)], self.known.of(states)
            if known is not None:
                allowed = th.split(th.as_tensor(known[rows], device=self.device), self.known.sizes, dim=1)
                pairs = zip(of_dimensions, allowed, strict=True)
                of_dimensions = [log_probs.masked_fill(~mask, -th.inf) for log_probs, mask in pairs]
            return th.stack([one.argmax(dim=1) for one in of_dimensions], dim=1).cpu().numpy()

        return th.as_tensor(self._completions.rows(states, find), device=self.device)


class ConditionalDistribution(MultiCategoricalDistribution):
    """A policy's distribution, drawn from by a :class:`ConditionalGuide`. Its entropy has no analytic form."""

    def __init__(self, guide: ConditionalGuide, obs: Any, distribution: Distribution):
        super().__init__([len(block) for block in guide.blocks])
        self.guide, self.obs, self.plain = guide, obs, distribution

    def sample(self) -> th.Tensor:
        """(n, action_dim)."""
        return self._drawn(lambda one: one.sample())  # type: ignore[no-untyped-call]

    def mode(self) -> th.Tensor:
        """(n, action_dim), in each block the most probable combination given the earlier ones."""
        return self._drawn(lambda one: one.logits.argmax(dim=1))

    def _drawn(self, choose: Callable[[Categorical], th.Tensor]) -> th.Tensor:
        return in_type_of(self.guide.space, self.guide.draw(self.obs, self.plain, choose))

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """(n,) of (n, action_dim) actions."""
        masks = self.guide.masks_of(self.obs, self.plain, actions)
        return MaskedProduct(self.plain, self.guide.blocks, masks, self.guide.space).log_prob(actions)

    def entropy(self) -> Any:
        return None


def consecutive_blocks(sizes: list[int], device: th.device) -> list[Block]:
    """All dimensions in their order, as many to a block as have :data:`BLOCK` combinations at most."""
    found: list[list[int]] = []
    combinations = BLOCK + 1
    for dimension, size in enumerate(sizes):
        combinations *= size
        if combinations > BLOCK:
            found.append([])
            combinations = size
        found[-1].append(dimension)
    return [Block.of(dimensions, sizes, device) for dimensions in found]
