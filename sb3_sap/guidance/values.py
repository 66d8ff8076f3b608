"""Values of actions according to the critics or Q-networks of any off-policy algorithm."""

from __future__ import annotations

from typing import Any

import torch as th


def q_values(model: Any, obs: Any, actions: th.Tensor) -> th.Tensor:
    """(n,) values of (n, action_dim) scaled actions: the minimum over critics, or the mean over TQC's quantiles.

    :param model: any of SB3's and sb3-contrib's off-policy algorithms
    """
    model.policy.set_training_mode(False)  # evaluation must not move running statistics
    if hasattr(model, "critic"):
        values = model.critic(obs, actions)
        if isinstance(values, tuple):
            return th.cat(values, dim=1).min(dim=1).values
        return values.mean(dim=(1, 2))  # type: ignore[no-any-return]  # TQC: (n, critics, quantiles)
    return action_values(model, obs).gather(1, actions.long()).squeeze(1)


def action_values(model: Any, obs: Any) -> th.Tensor:
    """(n, actions) values of every discrete action, as DQN or QR-DQN sees them."""
    if hasattr(model, "quantile_net"):
        return model.quantile_net(obs).mean(dim=1)  # type: ignore[no-any-return]  # (n, quantiles, actions)
    return model.q_net(obs)  # type: ignore[no-any-return]
