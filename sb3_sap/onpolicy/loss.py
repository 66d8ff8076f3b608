"""A loss towards permissible actions within the updates of an on-policy algorithm (not in the paper)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.onpolicy.guide import Guide


class PermissibilityLoss:
    """β times :meth:`~sb3_sap.onpolicy.guide.Guide.losses`, whose gradient joins that of the base algorithm's own loss.

    For continuous actions softplus(−E(s, mode)), the cross-entropy of the mode under E, had it been labelled
    permissible. For finite actions −log of the probability that the policy gives to what E permits: masked actions
    have no gradient, so that without it the policy alone might take one that it never tried.

    :param guide: with E, and with the known masks of the rollout
    :param coef: β times the trust in the labels, in units of the advantages that the base learns from
    :param record: is called with the mean loss of each mini-batch, without the coefficient
    """

    def __init__(self, guide: Guide, coef: float, record: Callable[[float], None]):
        self.guide, self.coef, self.record = guide, coef, record

    @flush_denormals()
    def added_to(self, log_prob: th.Tensor, obs: Any, distribution: Distribution, recurrent: bool) -> th.Tensor:
        """Log-probabilities as they are, through which a backward pass also differentiates this loss.

        The base's mini-batches, its bound on the gradient and its optimizer's step are then those of the sum.

        :param log_prob: (n,) of the executed actions, to which any loss of a policy gradient leads back
        :param obs: n observation tensors
        :param distribution: of the policy alone in these states
        :param recurrent: whether zeros pad the sequences of observations
        """
        found = self.guide.losses(obs, distribution)
        if recurrent:
            entries = obs.values() if isinstance(obs, dict) else [obs]
            real = th.stack([entry.flatten(1).ne(0).any(dim=1) for entry in entries]).any(dim=0)
            found = found[real] if real.any() else found
        loss = found.mean()
        self.record(loss.item())
        return _WithLoss.apply(log_prob, self.coef * loss)  # type: ignore[no-any-return, no-untyped-call]


class _WithLoss(th.autograd.Function):
    """The identity of its first argument, whose backward pass gives the second, a loss, the gradient 1."""

    @staticmethod
    def forward(ctx: Any, values: th.Tensor, loss: th.Tensor) -> th.Tensor:
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> Any:
        return gradient, th.ones((), dtype=gradient.dtype, device=gradient.device)
