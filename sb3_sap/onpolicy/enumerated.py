"""Masks of all combinations of a finite action."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_sap.common.arrays import BoolArray, rows_of
from sb3_sap.common.spaces import joint_actions
from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.masks import MaskedDistribution, index_of, joint_log_probs
from sb3_sap.onpolicy.states import Remembered, keys_of
from sb3_sap.predictor.pairs import ManyActions, judge

#: Maximum number of pairs of a state and an action that E judges at once, which bounds the memory of its layers.
PAIRS_AT_ONCE = 32_768
#: Number of actions from which their share of E's first layer is computed once for all states.
MANY_ACTIONS = 64


class EnumeratedGuide(Guide):
    """Gives probability 0 to each combination that is rejected.

    Where E permits none of the actions that are known to be permissible, all of those are.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        actions = joint_actions(self.space)
        #: (k, action_dim) every action.
        self.actions = th.as_tensor(actions.reshape(len(actions), -1).astype(np.int64), device=self.device)
        self._verdicts = Remembered()
        # Few actions are judged faster by a pass for each pair.
        many = self.predictor is not None and len(self.actions) >= MANY_ACTIONS
        self._many = ManyActions(self.predictor, self.actions) if self.predictor is not None and many else None

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        mask = self.mask(obs)
        if executed is not None:
            # Where a state is judged anew, E's verdict at the border may depend on the size of the batch.
            mask[th.arange(len(mask), device=mask.device), index_of(self.space, executed)] = True
        if mask.all():
            return distribution
        log_probs = joint_log_probs(distribution, self.actions)
        if executed is None:
            self.record("sap/rejection_rate", log_probs.detach().masked_fill(mask, -th.inf).exp().sum(dim=1))
        return MaskedDistribution(log_probs, mask, self.space, self.actions)

    def losses(self, obs: Any, distribution: Distribution) -> th.Tensor:
        """−log of the probability that the policy gives to what E permits."""
        mask = self.mask(obs)
        return -joint_log_probs(distribution, self.actions).masked_fill(~mask, -th.inf).logsumexp(dim=1)

    def mask(self, obs: Any) -> th.Tensor:
        """(n, k) bool, which of all k actions are permitted in n states."""
        states = keys_of(obs)
        known = self.known.of_combinations(states)
        if self.predictor is None:
            mask = np.ones((len(states), len(self.actions)), dtype=bool) if known is None else known
        else:
            mask = self._verdicts.rows(states, lambda new: self._judge(some_rows(obs, new, len(states))))
            mask = mask if known is None else within(mask, known)
        return th.as_tensor(mask, device=self.device)

    @th.no_grad()
    @flush_denormals()
    def _judge(self, obs: Any) -> BoolArray:
        """(n, k) bool, which of all actions E permits in n states; where it permits none, all."""
        assert self.predictor is not None
        features, k = self.predictor.features(obs), len(self.actions)
        batches = th.split(features, max(1, PAIRS_AT_ONCE // k))
        if self._many is not None:
            logits = self._many.logits(batches)
        else:
            logits = [judge(self.predictor, batch, self.actions.expand(len(batch), -1, -1)) for batch in batches]
        return within((th.cat(logits) > 0).cpu().numpy(), None)


def some_rows(obs: Any, rows: list[int], n: int) -> Any:
    """The observations of some of n states."""
    return obs if len(rows) == n else rows_of(obs, rows)


def within(mask: BoolArray, known: BoolArray | None) -> BoolArray:
    """E's masks within the known ones, (n, k); where E permits nothing of what is known to be permissible, all of it.

    Where it permits nothing at all and nothing is known, everything.
    """
    if known is None:
        return np.asarray(mask | ~mask.any(axis=1, keepdims=True))
    both = mask & known
    return np.where(both.any(axis=1, keepdims=True), both, known)
