"""Trains and validates the AP predictor beside the agent (section 4.2)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback

from sb3_sap.predictor.knowledge import NON_PERMISSIBLE, PERMISSIBLE, KnowledgeBuffer
from sb3_sap.predictor.tensorboard import add_layout

#: Number of labels after which a warning is given if all are of one class.
CONSTANT_LABELS_WARNING = 1_000


class PermissibilityCallback(BaseCallback):
    """Fits and validates E at the end of each rollout, as often as the model's settings say.

    For an on-policy algorithm, which calls :meth:`refit` itself, after the update that follows the rollout.

    A guided model adds one automatically. To change how E is trained, override :meth:`fit` or :meth:`validate` and
    pass an instance to ``learn(callback=...)``: it replaces the default one.
    """

    model: Any  # a guided model, that is a LearnedPredictorMixin

    def __init__(self, verbose: int = 0):
        super().__init__(verbose)
        self._start = 0  # `lifetime_steps` at which the rollout began
        self._seen: tuple[int, ...] = (0, 0)  # labels of each class, when the rollout began
        self._warned = False

    @property
    def knowledge(self) -> KnowledgeBuffer:
        """The model's K."""
        return self.model.knowledge  # type: ignore[no-any-return]

    def _on_training_start(self) -> None:
        add_layout(self.logger)

    def _on_rollout_start(self) -> None:
        self._start = self.model.lifetime_steps
        self._seen = tuple(self.knowledge.seen)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        # The transitions of this rollout are in K only now: `_on_step` runs before they are stored.
        knowledge = self.knowledge
        new = np.subtract(knowledge.seen, self._seen)
        if new.any():
            self.logger.record_mean("sap/permissible_rate", new[PERMISSIBLE] / new.sum())
        if not self._warned and sum(knowledge.seen) >= CONSTANT_LABELS_WARNING and min(knowledge.seen) == 0:
            self._warn_of_constant_labels(knowledge.seen)
        if self.model.familiarity is not None:
            self.model.test_familiarity()
        if not getattr(self.model, "fits_in_train", False):
            n_envs = self.model.n_envs
            due = self.model.refits_due(self._start // n_envs, self.model.lifetime_steps // n_envs)
            self.refit(int(min(due, self.model.fits_per_rollout)))

    def refit(self, n: int) -> None:
        """Fits E ``n`` times, if K holds enough examples, and validates it once."""
        if self.model.freeze_predictor:
            n = 0
        if self.knowledge.holds("train", self.model.min_per_class):
            for _ in range(n):
                self.fit()
        if n > 0 and self.model.predictor.fitted and self.knowledge.holds("validation", 1):
            self.validate()

    def fit(self) -> None:
        """One pass over a balanced D_E of ``dataset_size`` examples."""
        examples, weights = self.model.draw_examples()
        weighing = () if weights is None else (weights,)
        self.logger.record_mean("sap/predictor_loss", self.model.predictor.fit(examples, *weighing))
        self.model.after_fit()

    def validate(self) -> None:
        """Measures E on ``validation_size`` held-out examples; the gate of α depends on the result."""
        model = self.model
        sample = self.knowledge.sample(model.validation_size, "validation", model.get_vec_normalize_env())
        non_permissible, permissible = model.predictor.recall(sample)
        model.validation_accuracy = (non_permissible + permissible) / 2
        for name, accuracy in zip(model.parts.names, model.predictor.accuracies if model.parts else (), strict=True):
            self.logger.record(f"sap/validation_accuracy_{name}", float(accuracy))
        model.describe_predictor()
        self.logger.record("sap/validation_accuracy", model.validation_accuracy)
        self.logger.record("sap/validation_accuracy_permissible", permissible)
        self.logger.record("sap/validation_accuracy_non_permissible", non_permissible)

    def _warn_of_constant_labels(self, seen: list[int]) -> None:
        self._warned = True
        label = "permissible" if seen[NON_PERMISSIBLE] == 0 else "non-permissible"
        warnings.warn(
            f"The AP function labelled all of the first {sum(seen)} actions {label}: from constant labels "
            "nothing can be learned, and the run equals one without guidance. Check the AP function.",
            stacklevel=2,
        )


def contains_permissibility_callback(callback: object) -> bool:
    """Whether the user's callbacks, nested lists included, contain a :class:`PermissibilityCallback`."""
    if isinstance(callback, PermissibilityCallback):
        return True
    if isinstance(callback, list):
        return any([contains_permissibility_callback(child) for child in callback])
    if isinstance(callback, CallbackList):
        return contains_permissibility_callback(callback.callbacks)
    if isinstance(callback, EventCallback):
        _refuse_inside(callback)
    return False


def _refuse_inside(event: EventCallback) -> None:
    # SB3's event callbacks do not pass the end of a rollout on to their children: E would never be trained.
    children = [event.callback, getattr(event, "callback_on_new_best", None)]
    if contains_permissibility_callback(children):
        raise ValueError(
            f"A PermissibilityCallback inside {type(event).__name__} would never train the AP predictor, because it is "
            "not called there when a rollout ends: pass it to `learn(callback=[...])` itself."
        )
