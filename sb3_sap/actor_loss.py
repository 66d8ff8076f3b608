"""The permissible actor loss: what E knows, taught to the actor itself. It goes beyond the paper."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional as F

from sb3_sap.predictor import PermissibilityPredictor, flush_denormals


@flush_denormals()
def permissible_actor_step(
    actor: Any,
    predictor: PermissibilityPredictor,
    replay_buffer: ReplayBuffer,
    coef: float,
    batch_size: int,
    env: VecNormalize | None = None,
) -> float:
    """One gradient step of the actor on β · softplus(−E(s, μ(s))), E itself held fixed.

    This is the cross-entropy of the actor's own action under the predictor, had it been labelled permissible. An
    optimal action is permissible by Definition 3, so under a perfect E the term vanishes at the optimum.

    :param actor: with its ``optimizer``; of a stochastic one the mean action counts, so that its entropy is left alone
    :param coef: β
    :param batch_size: states drawn from the replay buffer
    :param env: normalises the states, if given
    :return: the loss before the step
    """
    observations = replay_buffer.sample(batch_size, env=env).observations
    # An extra pass must not move running statistics (CrossQ's batch renormalisation).
    actor.set_training_mode(False)
    stochastic = hasattr(actor, "action_log_prob")
    actions: th.Tensor = actor(observations, deterministic=True) if stochastic else actor(observations)
    loss = coef * F.softplus(-predictor(observations, actions)).mean()
    actor.optimizer.zero_grad()
    loss.backward(inputs=list(actor.parameters()))  # type: ignore[no-untyped-call]
    actor.optimizer.step()
    return loss.item()
