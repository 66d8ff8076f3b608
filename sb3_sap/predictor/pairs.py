"""E's judgement of many finite actions in many states at once.

Of the first layer, whose inputs are mostly those of a one-hot action, features and actions have their shares once: for
many actions that is far faster than a pass for each pair. The logits differ by rounding alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_sap.common.spaces import sizes_of
from sb3_sap.predictor.encoding import encoded_actions
from sb3_sap.predictor.network import PermissibilityPredictor


def logits_of_each(
    predictor: PermissibilityPredictor, batches: Sequence[th.Tensor], actions: th.Tensor
) -> list[th.Tensor]:
    """(n, k) logits of k actions in the n states of each batch.

    :param batches: (n, features_dim) features
    :param actions: (k, action_dim), scaled
    """
    if predictor.own_inputs is None:
        found: Iterable[th.Tensor] = _outputs(predictor, batches, actions)
    else:  # each part by itself, which sees its own inputs alone
        each = [
            [outputs[:, part] for outputs in _outputs(predictor, batches, actions, own)]
            for part, own in enumerate(predictor.own_inputs)
        ]
        found = (th.stack(parts, dim=1) for parts in zip(*each, strict=True))
    return [predictor.of_all(outputs).reshape(-1, len(actions)) for outputs in found]


def logits_of_choices(
    predictor: PermissibilityPredictor, batches: Sequence[th.Tensor], part: int, choices: th.Tensor
) -> list[th.Tensor]:
    """(n, m) logits of m choices for one part of a ``MultiDiscrete`` or ``MultiBinary`` action, judged by itself.

    :param batches: (n, features_dim) features
    :param part: its number
    :param choices: (m, dimensions of the part)
    """
    assert predictor.own_inputs is not None
    actions = choices.new_zeros((len(choices), len(sizes_of(predictor.action_space))))
    actions[:, list(predictor.parts.indices[part])] = choices
    outputs = _outputs(predictor, batches, actions, predictor.own_inputs[part])
    return [found[:, part].reshape(-1, len(choices)) for found in outputs]


def _outputs(
    predictor: PermissibilityPredictor, batches: Sequence[th.Tensor], actions: th.Tensor, own: th.Tensor | None = None
) -> Iterator[th.Tensor]:
    """(n m, outputs) of each state of a batch with each of m actions, for one batch after the other.

    :param own: the inputs of the action that are seen; ``None``: all
    """
    first, *others = cast(Iterable[Any], predictor.head)
    of_features, of_actions = first.weight.tensor_split([batches[0].shape[1]], dim=1)
    if isinstance(predictor.action_space, spaces.Discrete):
        share = of_actions.t()[actions.flatten().long()]
    else:
        encoded = encoded_actions(predictor.action_space, actions).to(of_actions.dtype)
        share = F.linear(encoded if own is None else encoded * own, of_actions)
    for batch in batches:
        hidden = (F.linear(batch, of_features, first.bias)[:, None] + share).flatten(0, 1)
        for layer in others:
            hidden = layer(hidden)
        yield hidden
