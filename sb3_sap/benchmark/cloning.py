"""Behavioural cloning, the rival of a policy that is taught what is permissible."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.teaching import cloning_step
from sb3_sap.transitions.batch import Transitions

#: Gradient steps, as many as `teach_policy` takes.
STEPS = 1_000


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
