"""E's judgement of several actions in each of several states."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_sap.common.arrays import FloatArray
from sb3_sap.predictor.encoding import encoded_actions
from sb3_sap.predictor.network import PermissibilityPredictor


def judge(
    predictor: PermissibilityPredictor, features: th.Tensor, actions: th.Tensor, part: int | None = None
) -> th.Tensor:
    """(m, n) logits of n actions in each of m states, in one call; above zero means permissible.

    :param features: (m, features_dim)
    :param actions: (m, n, action_dim), scaled
    :param part: the part of the action that is judged; None: the whole
    """
    if getattr(predictor, "output_per_action", False):  # anything that has `logits` may judge
        return predictor.head(features).gather(1, actions[..., 0].long()) - predictor.offset  # type: ignore[no-any-return]
    m, n = actions.shape[:2]
    pairs = features.expand(n, -1) if m == 1 else features.repeat_interleave(n, dim=0), actions.reshape(m * n, -1)
    logits = predictor.logits(*pairs) if part is None else predictor.part_logits(*pairs)[:, part]
    return logits.reshape(m, n)


def query_candidates(
    predictor: PermissibilityPredictor,
    features: th.Tensor,
    candidates: np.ndarray[Any, Any],
    part: int | None = None,
) -> FloatArray:
    """The same of (m, n, action_dim) candidates that are no tensors."""
    actions = th.as_tensor(candidates, device=features.device)
    return judge(predictor, features, actions, part).cpu().numpy()


class ManyActions:
    """The same finite actions in many states.

    Of E's first layer, whose inputs are mostly those of a one-hot action, features and actions have their shares once,
    and that of the actions is computed again only after E was fitted: for many actions this is far faster than a pass
    for each pair. The logits differ by rounding alone.

    :param predictor: E
    :param actions: (k, action_dim), scaled
    :param parts: (k,) numbers of the parts of a ``MultiDiscrete`` or ``MultiBinary`` action, of which each action is
        judged by that one alone; ``None``: by all
    """

    def __init__(self, predictor: PermissibilityPredictor, actions: th.Tensor, parts: th.Tensor | None = None):
        self.predictor, self.actions, self.parts = predictor, actions, parts
        #: (k, width) of the first layer, one for each output that sees its own inputs.
        self._shares: list[th.Tensor] = []
        self._fitted = -1

    def logits(self, batches: Sequence[th.Tensor]) -> list[th.Tensor]:
        """(n, k) logits in the n states of each batch.

        :param batches: (n, features_dim) features
        """
        if self.predictor.output_per_action:
            chosen = self.actions.flatten().long()
            return [self.predictor.head(batch)[:, chosen] - self.predictor.offset for batch in batches]
        if self._fitted != int(self.predictor.n_updates):
            self._shares, self._fitted = self._shares_now(), int(self.predictor.n_updates)
        found: Iterable[th.Tensor]
        if self.parts is not None:
            parts = self.parts
            each_batch = zip(self._outputs(batches, self._shares[0]), batches, strict=True)
            found = (outputs.gather(1, parts.repeat(len(batch))[:, None]) for outputs, batch in each_batch)
        elif self.predictor.own_inputs is None:
            found = (self.predictor.of_all(outputs) for outputs in self._outputs(batches, self._shares[0]))
        else:
            each = [
                [outputs[:, part] for outputs in self._outputs(batches, share)]
                for part, share in enumerate(self._shares)
            ]
            found = (self.predictor.of_all(th.stack(columns, dim=1)) for columns in zip(*each, strict=True))
        return [logits.reshape(-1, len(self.actions)) for logits in found]

    def _shares_now(self) -> list[th.Tensor]:
        space, own = self.predictor.action_space, self.predictor.own_inputs
        of_actions = self._first.weight[:, -self._first_inputs :]
        if isinstance(space, spaces.Discrete):
            return [of_actions.t()[self.actions.flatten().long()]]
        encoded = encoded_actions(space, self.actions).to(of_actions.dtype)
        if own is None:
            return [F.linear(encoded, of_actions)]
        if self.parts is not None:
            return [F.linear(encoded * own[self.parts], of_actions)]
        return [F.linear(encoded * inputs, of_actions) for inputs in own]

    @property
    def _first(self) -> Any:
        return cast(Any, self.predictor.head)[0]

    @property
    def _first_inputs(self) -> int:
        """The number of inputs of the action."""
        return int(self._first.weight.shape[1]) - self.predictor.features_extractor.features_dim

    def _outputs(self, batches: Sequence[th.Tensor], share: th.Tensor) -> Iterator[th.Tensor]:
        """(n k, outputs) of each pair, for one batch after the other."""
        _, *others = cast(Iterable[Any], self.predictor.head)
        of_features = self._first.weight[:, : -self._first_inputs]
        for batch in batches:
            hidden = (F.linear(batch, of_features, self._first.bias)[:, None] + share).flatten(0, 1)
            for layer in others:
                hidden = layer(hidden)
            yield hidden - self.predictor.offset
