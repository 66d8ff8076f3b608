"""E's judgement of the same finite actions in many states.

Of the first layer, whose inputs are mostly those of a one-hot action, features and actions have their shares once: for
many actions that is far faster than a pass for each pair. The logits differ by rounding alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_sap.predictor.encoding import encoded_actions
from sb3_sap.predictor.network import PermissibilityPredictor


class ManyActions:
    """Many actions, whose share of E's first layer is computed again only after E was fitted.

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
