"""A loss towards permissible actions after each update of an on-policy algorithm (not in the paper)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from torch.nn import functional as F

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.masks import joint_log_probs


@flush_denormals()
def permissibility_passes(model: Any, guide: Guide, coef: float, n_passes: int) -> float:
    """Mini-batch gradient steps of the policy on β times :func:`losses`, over the states of the last rollout.

    They are steps of the policy's own optimizer, with the base's mini-batches and its bound on the gradient. The
    base's policy gradient is in units of the advantage; where it is not normalised, β is multiplied by the standard
    deviation of the rollout's advantages, so that one β suits rewards of every scale.

    :param model: an on-policy model after ``train()``
    :param coef: β
    :param n_passes: passes over the rollout
    :return: the mean loss, without β
    """
    policy, buffer = model.policy, model.rollout_buffer
    policy.set_training_mode(False)  # an extra pass must not move running statistics
    scale = 1.0 if getattr(model, "normalize_advantage", False) else float(np.std(buffer.advantages))
    trained = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    found = []
    for _ in range(n_passes):
        for data in buffer.get(getattr(model, "batch_size", None)):
            if hasattr(data, "lstm_states"):
                distribution, _ = policy.get_distribution(data.observations, data.lstm_states.pi, data.episode_starts)
                loss = losses(guide, data.observations, distribution)[data.mask > 1e-8].mean()  # not the padding
            else:
                loss = losses(guide, data.observations, policy.get_distribution(data.observations)).mean()
            policy.optimizer.zero_grad()
            (coef * scale * loss).backward(inputs=trained)  # type: ignore[no-untyped-call]
            if model.max_grad_norm > 0:  # 0 for TRPO
                th.nn.utils.clip_grad_norm_(trained, model.max_grad_norm)
            policy.optimizer.step()
            found.append(loss.item())
    return float(np.mean(found))


def losses(guide: Guide, obs: Any, distribution: Distribution) -> th.Tensor:
    """(n,) how much a policy errs in n states, according to E.

    For continuous actions softplus(−E(s, mode)), the cross-entropy of the mode under E, had it been labelled
    permissible. For finite actions −log of the probability that the policy gives to what E permits: masked actions
    have no gradient, so that without it the policy alone might take one that it never tried.

    :param obs: n observation tensors
    :param distribution: of the policy alone in these states
    """
    if guide.actions is None:
        assert guide.predictor is not None
        mode = distribution.mode()
        # A mode outside the bounds is executed at the bound, where E judges it; the gradient may lead it back.
        clipped = guide.scaled(mode)
        free = mode if guide.squashed else guide.scaled_freely(mode)
        features = guide.predictor.features(obs).detach()
        return F.softplus(-guide.predictor.logits(features, free + (clipped - free).detach()))
    mask = guide.mask(obs)
    return -joint_log_probs(distribution, guide.actions).masked_fill(~mask, -th.inf).logsumexp(dim=1)
