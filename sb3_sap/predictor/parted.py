"""The knowledge buffer K of labels per part of the action."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sap.common.arrays import Observations, joined_rows, rows_of
from sb3_sap.predictor.knowledge import KnowledgeBuffer, LabelledActions, Part, PriorKnowledge


class PartedKnowledge(KnowledgeBuffer):
    """K with a store for each part of the action, beside one of whether all parts were permissible.

    Each part has its own balance of classes, so that a part that seldom errs is learned as well as one that often does.

    :param names: of the parts
    :param args: those of :class:`~sb3_sap.predictor.knowledge.KnowledgeBuffer`
    """

    #: The kind of the stores.
    kind: ClassVar[type[KnowledgeBuffer]] = KnowledgeBuffer

    def __init__(self, names: tuple[str, ...], *args: Any):
        self.each: list[KnowledgeBuffer] = []
        super().__init__(*args)
        self.part_names = names
        self.each = [self.kind(*args) for _ in names]
        self._seed_each()

    def seed(self, seed: int | None) -> None:
        super().seed(seed)
        self._seed_each()

    def _seed_each(self) -> None:
        for store, rng in zip(self.each, self.rng.spawn(len(self.each)), strict=True):
            store.rng = rng

    def add(self, obs: Observations, actions: np.ndarray[Any, Any], labels: np.ndarray[Any, Any]) -> None:
        """Adds n labelled actions.

        :param obs: (n, *obs_shape), raw
        :param actions: (n, action_dim), scaled
        :param labels: (n, k) bool, one label for each part
        """
        super().add(obs, actions, np.asarray(labels.all(axis=1)))
        for number, store in enumerate(self.each):
            store.add(obs, actions, labels[:, number])

    def holds(self, part: Part, n: int) -> bool:
        """Whether a part of K has n tuples of each class for at least one part of the action."""
        self._share_prior()
        return any(store.holds(part, n) for store in self.each)

    def sample(
        self, n: int, part: Part = "train", env: VecNormalize | None = None, balanced: bool = True
    ) -> LabelledActions:
        """Draws a balanced D_E for each part of the action, in random order.

        :return: labels are (k n, k), NaN but for the part that a row was drawn for. A part of the action of which one
            class is missing has no rows
        """
        self._share_prior()
        return self._joined([store.sample(n, part, env, balanced) if ok else None for store, ok in self._ready(part)])

    def sample_own(
        self, n: int, part: Part = "train", env: VecNormalize | None = None, balanced: bool = True
    ) -> LabelledActions:
        """The same without `prior`."""
        chosen = [(store, min(store.counts(part)) > 0) for store in self.each]
        return self._joined([store.sample_own(n, part, env, balanced) if ok else None for store, ok in chosen])

    def _ready(self, part: Part) -> list[tuple[KnowledgeBuffer, bool]]:
        least = self.min_per_class if part == "train" else 1
        return [(store, store.holds(part, least)) for store in self.each]

    def _joined(self, samples: list[LabelledActions | None]) -> LabelledActions:
        found = [(number, sample) for number, sample in enumerate(samples) if sample is not None]
        labels = []
        for number, sample in found:
            own = np.full((len(sample.labels), len(samples)), np.nan, dtype=np.float32)
            own[:, number] = sample.labels
            labels.append(own)
        joined = [joined_rows([sample[field] for _, sample in found]) for field in (0, 1)]
        order = self.rng.permutation(sum(map(len, labels)))
        return LabelledActions(*(rows_of(rows, order) for rows in (*joined, np.concatenate(labels))))

    def _share_prior(self) -> None:
        """Gives each store its part of `prior`."""
        older = getattr(self.prior, "each", None) or [None] * len(self.each)
        for store, prior in zip(self.each, older, strict=True):
            store.prior, store.prior_share = prior, self.prior_share


class PartedPriorKnowledge(PartedKnowledge, PriorKnowledge):
    """The same of what is known from elsewhere."""

    kind = PriorKnowledge
