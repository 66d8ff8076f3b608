"""How the predictor E reads actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_sap.common.action_parts import ActionParts
from sb3_sap.common.spaces import sizes_of


def encoded_actions(space: spaces.Space[Any], actions: th.Tensor) -> th.Tensor:
    """(n, input_dim) actions as E sees them: one-hot in each discrete dimension, else as they are."""
    if isinstance(space, spaces.Discrete):
        return F.one_hot(actions.flatten().long(), int(space.n))
    if isinstance(space, spaces.MultiDiscrete):
        columns = zip(actions.long().unbind(dim=1), space.nvec.tolist(), strict=True)
        return th.cat([F.one_hot(column, n) for column, n in columns], dim=1)
    return actions


def own_inputs(space: spaces.Space[Any], parts: ActionParts) -> th.Tensor | None:
    """(k, input_dim) 1 where an input of E belongs to a part of a finite action; ``None``: every output sees all."""
    if not parts or not isinstance(space, (spaces.MultiDiscrete, spaces.MultiBinary)):
        return None
    widths = sizes_of(space) if isinstance(space, spaces.MultiDiscrete) else [1] * len(sizes_of(space))
    dimension = np.repeat(np.arange(len(widths)), widths)
    return th.as_tensor(np.stack([np.isin(dimension, own) for own in parts.indices]), dtype=th.float32)
