"""Auxiliary actor loss towards actions predicted permissible (not in the paper)."""

from __future__ import annotations

from typing import Any

import torch as th
from torch.nn import functional as F

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.values import action_values
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.pairs import judge


@flush_denormals()
def permissible_actor_step(actor: Any, predictor: PermissibilityPredictor, observations: Any, coef: float) -> float:
    """One gradient step of the actor on β · softplus(−E(s, μ(s))), E itself held fixed.

    This is the cross-entropy of the actor's own action under the predictor, had it been labelled permissible. An
    optimal action is permissible by Definition 3, so under a perfect E the term vanishes at the optimum.

    :param actor: with its ``optimizer``; the mean action of a stochastic one is used, so that its entropy is unaffected
    :param observations: n observation tensors
    :param coef: β
    :return: the loss before the step
    """
    loss = coef * rejection(predictor, observations, mean_action(actor, observations))
    actor.optimizer.zero_grad()
    trained = [parameter for parameter in actor.parameters() if parameter.requires_grad]  # some may be frozen
    if trained:
        loss.backward(inputs=trained)  # type: ignore[no-untyped-call]
    actor.optimizer.step()
    return loss.item()


def rejection(predictor: PermissibilityPredictor, observations: Any, actions: th.Tensor) -> th.Tensor:
    """softplus(−E(s, a)) on average, which has a gradient towards permissible actions.

    With parts it is the sum over the parts that are accurate enough, and each has a gradient in its own dimensions
    alone: a wrong pedal must not move the steering.

    :param observations: n observation tensors
    :param actions: (n, action_dim), scaled
    """
    if not predictor.parts:
        return F.softplus(-predictor(observations, actions)).mean()
    features, total = predictor.features(observations), actions.new_zeros(())
    for number in th.where(predictor.trusted)[0].tolist():
        own = th.zeros(actions.shape[1], dtype=th.bool, device=actions.device)
        own[list(predictor.parts.indices[number])] = True
        logits = predictor.part_logits(features, th.where(own, actions, actions.detach()))[:, number]
        total = total + F.softplus(-logits).mean()
    return total


def mean_action(actor: Any, observations: Any) -> th.Tensor:
    """(n, action_dim) scaled actions of an actor in evaluation mode; of a stochastic one, its mean actions."""
    # An extra pass must not move running statistics (CrossQ's batch renormalisation).
    actor.set_training_mode(False)
    stochastic = hasattr(actor, "action_log_prob")
    actions: th.Tensor = actor(observations, deterministic=True) if stochastic else actor(observations)
    return actions


@flush_denormals()
def permissible_value_step(model: Any, predictor: PermissibilityPredictor, observations: Any, coef: float) -> float:
    """One gradient step of the Q-values on β times :func:`preference_loss`.

    :param model: DQN or QR-DQN
    :param observations: n observation tensors
    :return: the loss before the step; 0 if in no state E rejects some actions and permits others
    """
    loss = coef * preference_loss(model, predictor, observations)
    if not loss.requires_grad:
        return 0.0
    model.policy.optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    model.policy.optimizer.step()
    return loss.item()


def preference_loss(model: Any, predictor: PermissibilityPredictor, observations: Any) -> th.Tensor:
    """softplus(Q(s, a) − Q(s, b)) on average, for discrete actions.

    a is each action that E rejects, b the action of highest value that E permits: the loss is the cross-entropy of
    preferring b to a. Experience never corrects the values of actions that guidance prevents: with negative rewards,
    an unknown action looks better than every known one. By Definition 3 no optimal policy takes it, so that its value
    is free. Both values have a gradient, because lowering one alone would lower all that share its features, for ever.

    :param model: DQN or QR-DQN
    :return: the loss; 0 without a gradient if in no state E rejects some actions and permits others
    """
    model.policy.set_training_mode(False)
    values = action_values(model, observations)  # (n, k)
    n, k = values.shape
    with th.no_grad():
        actions = th.arange(k, device=values.device).repeat(n, 1)
        rejected = judge(predictor, predictor.features(observations), actions[:, :, None]) <= 0
    best = values.masked_fill(rejected, -th.inf).max(dim=1, keepdim=True).values
    separated = rejected & best.isfinite()
    if not separated.any():
        return th.zeros(())
    return F.softplus(values - best)[separated].mean()
