"""Masks of parts of a finite action, each judged by itself, for any number of combinations."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_sap.common.action_parts import ActionParts
from sb3_sap.common.arrays import BoolArray
from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.onpolicy.blocks import Block, MaskedProduct, permitted_share
from sb3_sap.onpolicy.enumerated import PAIRS_AT_ONCE, some_rows, within
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.states import Remembered, keys_of
from sb3_sap.predictor.pairs import ManyActions


class FactoredGuide(Guide):
    """Gives probability 0 to each choice of a part that is rejected; a dimension in no part is a part by itself.

    The distribution is the product of those of the parts. E judges each part that is accurate enough, from its own
    dimensions alone; the others are restricted by the known masks of their dimensions. Where nothing of a part is
    permitted all that is known to be permissible is, whatever the other parts.

    :param parts: those that E judges
    """

    def __init__(self, *args: Any, parts: ActionParts, **kwargs: Any):
        super().__init__(*args, **kwargs)
        sizes = self.known.sizes
        judged = [] if self.predictor is None else [list(dimensions) for dimensions in parts.indices]
        of_parts = {dimension for dimensions in judged for dimension in dimensions}
        alone = [[dimension] for dimension in range(len(sizes)) if dimension not in of_parts]
        self.blocks = [Block.of(dimensions, sizes, self.device) for dimensions in judged + alone]
        self._judged = self.blocks[: len(judged)]
        if self.predictor is not None:
            # (k, action_dim) every choice of every part, beside which the other dimensions are not seen.
            choices = [th.zeros((len(block), len(sizes)), dtype=th.long, device=self.device) for block in self._judged]
            for block, actions in zip(self._judged, choices, strict=True):
                actions[:, block.dimensions] = block.choices
            numbers = th.arange(len(judged), device=self.device)
            self._part_of = numbers.repeat_interleave(th.tensor([len(block) for block in self._judged]).to(self.device))
            self._many = ManyActions(self.predictor, th.cat(choices), self._part_of)
        self._verdicts = Remembered()
        # In the order of their dimensions, as sb3-contrib's distributions are.
        self._order = sorted(range(len(self.blocks)), key=lambda number: self.blocks[number].dimensions)

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        masks = self.masks(obs)
        if executed is not None:
            # Where a state is judged anew, E's verdict at the border may depend on the size of the batch.
            for block, mask in zip(self.blocks, masks, strict=True):
                mask[th.arange(len(mask), device=mask.device), block.index_of(executed)] = True
        if all(mask.all() for mask in masks):
            return distribution
        blocks, masks = [self.blocks[i] for i in self._order], [masks[i] for i in self._order]
        if executed is None:
            with th.no_grad():
                self.record("sap/rejection_rate", 1 - permitted_share(distribution, blocks, masks).exp())
        return MaskedProduct(distribution, blocks, masks, self.space)

    def losses(self, obs: Any, distribution: Distribution) -> th.Tensor:
        """−log of the probability that the policy gives to what E permits."""
        return -permitted_share(distribution, self.blocks, self.masks(obs))

    def masks(self, obs: Any) -> list[th.Tensor]:
        """(n, m) bool for each block, which of its m combinations are permitted in n states."""
        states = keys_of(obs)
        known = self.known.of(states)
        of_e: list[BoolArray] = [np.ones((len(states), len(block)), dtype=bool) for block in self.blocks]
        if self.predictor is not None:
            found = self._verdicts.rows(states, lambda new: self._judge(some_rows(obs, new, len(states))))
            ends = np.cumsum([len(block) for block in self._judged])
            of_e[: len(ends)] = np.split(found, ends[:-1], axis=1)
        sizes = self.known.sizes
        masks = [
            within(mask, None if known is None else block.known(known, sizes))
            for block, mask in zip(self.blocks, of_e, strict=True)
        ]
        return [th.as_tensor(mask, device=self.device) for mask in masks]

    @th.no_grad()
    @flush_denormals()
    def _judge(self, obs: Any) -> BoolArray:
        """E's verdicts on the choices of all parts in n states, side by side; what it does not judge, it permits."""
        assert self.predictor is not None
        batches = th.split(self.predictor.features(obs), max(1, PAIRS_AT_ONCE // len(self._part_of)))
        permitted = th.cat(self._many.logits(batches)) > 0
        return (permitted | ~self.predictor.trusted[self._part_of]).cpu().numpy()
