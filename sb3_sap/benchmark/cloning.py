"""Behavioural cloning, the rival of a policy that is taught what is permissible."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from torch.nn import functional as F

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.auxiliary_loss import mean_action
from sb3_sap.transitions.batch import Transitions

#: Gradient steps, as many as `teach_policy` takes.
STEPS = 1_000
#: What an action at the bounds counts as where a squashed distribution learns from it.
INSIDE = 0.99


@flush_denormals()
def clone(model: Any, transitions: Transitions) -> None:
    """Lets the actor of an off-policy model imitate all actions of some transitions."""
    rng = np.random.default_rng(model.seed)
    for _ in range(STEPS):
        rows = transitions.rows(rng.integers(len(transitions), size=model.predictor.batch_size))
        actions = th.as_tensor(model.policy.scale_action(rows.actions), device=model.device)
        cloning_step(model.actor, model.policy.obs_to_tensor(rows.obs)[0], actions)
    if getattr(model, "actor_target", None) is not None:
        model.actor_target.load_state_dict(model.actor.state_dict())


def cloning_step(actor: Any, observations: Any, actions: th.Tensor) -> None:
    """One gradient step towards given actions: on the mean squared distance of a deterministic actor from them, and on
    minus the log-likelihood of a stochastic one, which also learns how much they vary.

    :param actor: with its ``optimizer``
    :param observations: n observation tensors
    :param actions: (n, action_dim), scaled
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
