"""Gradient steps of an actor that is taught before the first step, by E or by a log (not in the paper)."""

from __future__ import annotations

import math
from typing import Any

import torch as th
from torch.nn import functional as F

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.auxiliary_loss import mean_action, rejection
from sb3_sap.predictor.network import PermissibilityPredictor

#: Standard deviation, before the squashing, of the actions of a stochastic actor that E has taught.
SPREAD = 0.3
#: What an action at the bounds counts as where a squashed distribution learns from it.
INSIDE = 0.99


@flush_denormals()
def taught_step(actor: Any, predictor: PermissibilityPredictor, observations: Any) -> float:
    """One gradient step of the actor on softplus(−E(s, μ(s))) + |μ(s)|², scaled, which has an optimum of its own.

    The cross-entropy alone never ends: it drives an actor that has nothing else to follow to the bounds of the action
    space, where E is most certain. The second term lets it move from the middle no further than E demands. A
    stochastic actor also learns to vary its actions by `SPREAD` instead of exploring as if it knew nothing.

    :param actor: with its ``optimizer``
    :param observations: n observation tensors
    :return: the loss before the step
    """
    actions = mean_action(actor, observations)
    loss = rejection(predictor, observations, actions) + (actions**2).sum(dim=1).mean()
    if hasattr(actor, "action_log_prob"):
        _, log_std, _ = actor.get_action_dist_params(observations)
        loss = loss + ((log_std - math.log(SPREAD)) ** 2).mean()
    actor.optimizer.zero_grad()
    trained = [parameter for parameter in actor.parameters() if parameter.requires_grad]
    loss.backward(inputs=trained)  # type: ignore[no-untyped-call]
    actor.optimizer.step()
    return float(loss.item())


@flush_denormals()
def cloning_step(actor: Any, observations: Any, actions: th.Tensor) -> float:
    """One gradient step towards given actions: on the mean squared distance of a deterministic actor from them, and on
    minus the log-likelihood of a stochastic one, which also learns how much they vary.

    :param actor: with its ``optimizer``
    :param observations: n observation tensors
    :param actions: (n, action_dim), scaled
    :return: the loss before the step
    """
    if hasattr(actor, "action_log_prob"):
        actor.set_training_mode(False)  # as in `mean_action`
        mean, log_std, more = actor.get_action_dist_params(observations)
        distribution = actor.action_dist.proba_distribution(mean, log_std, **more)
        # The bounds themselves have no likelihood under a squashed distribution.
        loss = -distribution.log_prob(actions.clamp(-INSIDE, INSIDE)).mean()
    else:
        loss = F.mse_loss(mean_action(actor, observations), actions)
    actor.optimizer.zero_grad()
    loss.backward()
    actor.optimizer.step()
    return float(loss.item())


@flush_denormals()
def valuing_step(
    model: Any, predictor: PermissibilityPredictor, observations: Any, actions: th.Tensor, worth: float
) -> float:
    """One gradient step of the critics towards Q(s, a) = c · σ(E(s, a)), for actions that nobody has tried.

    What bootstrapping learns afterwards of the actions of one policy raises all values alike and leaves the slope,
    without which that policy would move to actions whose values are unknown. With parts, σ is the mean over those that
    are accurate enough.

    :param model: with a ``critic``, and an actor
    :param observations: n observation tensors
    :param actions: (n, action_dim), scaled
    :param worth: c, in units of the reward
    :return: the loss before the step
    """
    model.policy.set_training_mode(False)  # CrossQ's running statistics are of the transitions
    with th.no_grad():
        of_parts = predictor.part_logits(predictor.features(observations), actions)
        permitted = th.sigmoid(of_parts[:, predictor.trusted] if predictor.parts else of_parts).mean(dim=1)
    values = model.critic(observations, actions)
    values = values if isinstance(values, tuple) else (values.flatten(1),)  # TQC: (n, critics, quantiles)
    loss = sum((F.mse_loss(own, (worth * permitted)[:, None].expand_as(own)) for own in values), actions.new_zeros(()))
    model.critic.optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    model.critic.optimizer.step()
    return float(loss.item())
