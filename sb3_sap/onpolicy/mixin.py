"""What turns an SB3 on-policy algorithm into one that learns and uses permissibility."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, Self, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import FloatSchedule

from sb3_sap.common.signatures import merged_signature
from sb3_sap.common.watching import every_callback
from sb3_sap.onpolicy.labels import LabelCallback
from sb3_sap.onpolicy.loss import PermissibilityLoss
from sb3_sap.onpolicy.policy import GuidedPolicyMixin
from sb3_sap.onpolicy.rollouts import GuidedRolloutsMixin
from sb3_sap.onpolicy.trust import Agreement
from sb3_sap.predictor.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.predictor.schedule import weighted_labels


class OnPolicyPermissibilityMixin(GuidedRolloutsMixin):
    """Guides an SB3 on-policy algorithm with a learned AP predictor E.

    Goes before the algorithm in the bases of a class. E is fixed while a rollout is collected, and then fitted, in
    proportion to the new labels. While it is accurate, its verdicts restrict the rollout
    (:func:`~sb3_sap.onpolicy.choosing.make_guide` says which way):

    - Finite actions are masked. Log-probabilities and entropy are those of the masked distribution, in the update
      with the same masks. Of several dimensions E judges each combination
      (:class:`~sb3_sap.onpolicy.enumerated.EnumeratedGuide`); with ``action_parts`` each part by itself, for any number
      of combinations (:class:`~sb3_sap.onpolicy.factored.FactoredGuide`); and of more than 4,096 combinations without
      parts one block of dimensions after the other (:class:`~sb3_sap.onpolicy.conditional.ConditionalGuide`).
    - Of continuous actions, the first of some draws from the policy that E permits is executed
      (:class:`~sb3_sap.onpolicy.draws.DrawingGuide`).

    Where E permits nothing everything is permitted. ``predict`` applies the masks of finite actions, too, unless
    ``guided=False`` is passed; of continuous actions it is the policy alone unless ``guided=True`` is passed.
    The parameters are those of :class:`~sb3_sap.onpolicy.settings.OnPolicySettingsMixin`. The chain, from the outside:
    this class learns, ``GuidedRolloutsMixin`` collects, ``OnPolicySettingsMixin`` holds settings and K,
    :class:`~sb3_sap.predictor.transfer.PriorKnowledgeMixin` and what it builds on hold E; then the algorithm.
    """

    _of_this_process: ClassVar[tuple[str, ...]] = (*GuidedRolloutsMixin._of_this_process, "_fit_callback")

    def __init__(self, *args: Any, **kwargs: Any):
        #: Of the labels with the advantages of the last rollouts.
        self.agreement = Agreement()
        self._labels_seen = 0  # labels that fits of E are due for or were made for
        self._examples_due = 0.0  # examples that E has yet to see
        self._fit_callback: PermissibilityCallback | None = None
        super().__init__(*args, **kwargs)

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        if any(base is OffPolicyAlgorithm for base in cls.__mro__):
            raise TypeError(
                f"{cls.__name__} puts {cls.__bases__[0].__name__} before an off-policy algorithm: choose an on-policy "
                "one, such as PPO, or put ActionPermissibilityMixin before it."
            )
        # The constructors pass *args and **kwargs on; editors and API pages should show the whole list.
        cls.__signature__ = merged_signature(cls)  # type: ignore[attr-defined]

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        given = callback if isinstance(callback, (list, BaseCallback)) else ConvertCallback(callback)
        callbacks: list[BaseCallback] = [] if contains_permissibility_callback(given) else [PermissibilityCallback()]
        self._label_callback = LabelCallback()
        callbacks = [*callbacks, *(given if isinstance(given, list) else [given]), self._label_callback]
        combined = super()._init_callback(cast(Any, callbacks), progress_bar)
        self._fit_callback = next(one for one in every_callback(combined) if isinstance(one, PermissibilityCallback))
        return combined

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """SB3's ``learn``."""
        if self.env is None:
            raise ValueError("This model has no environment to learn in: load it with one, or call `set_env` first.")
        self._set_label_source(self.labelled)  # a copied model has lost its AP function
        name = tb_log_name or type(self).__name__
        return super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)

    def train(self) -> None:
        """Fits of E to the new labels; then SB3's ``train``, with the masks of the rollout and the loss on E."""
        self._refit()
        labelled = self._label_callback.of_rollout(self.rollout_buffer.advantages)
        if labelled is not None:
            self.agreement.update(*labelled)
        coef = FloatSchedule(self.permissibility_coef)(self._current_progress_remaining) * float(self.agreement)
        policy = cast(GuidedPolicyMixin, self.policy)
        if coef > 0 and self._judges:
            guide = self._guide(known=None if self._rollout_guide is None else self._rollout_guide.known)
            # The policy gradient is in units of the advantage.
            scale = (
                1.0 if getattr(self, "normalize_advantage", False) else float(np.std(self.rollout_buffer.advantages))
            )
            record = partial(self.logger.record_mean, "sap/permissibility_loss")
            policy.permissibility_loss = PermissibilityLoss(guide, coef * scale, record)
        self.logger.record("sap/agreement", float(self.agreement))
        try:
            with self._guided_by(self._rollout_guide):
                super().train()
        finally:
            policy.permissibility_loss = None

    def _refit(self) -> None:
        """Fits E so often that it sees each new label as often as ``predictor_epochs`` says, on average."""
        seen = sum(self.knowledge.seen)
        new = weighted_labels(seen) - weighted_labels(self._labels_seen)
        due = self._examples_due + self.predictor_epochs * new
        # While one class is missing the fits remain due, as many as K can make use of.
        self._examples_due = min(due, self.predictor_epochs * weighted_labels(len(self.knowledge)))
        self._labels_seen = seen
        enough = min(self.knowledge.counts("train")) >= self.min_per_class
        fits = int(self._examples_due // self.dataset_size)
        if enough and fits > 0 and self._fit_callback is not None:
            self._examples_due -= fits * self.dataset_size
            self._fit_callback.refit(fits)
