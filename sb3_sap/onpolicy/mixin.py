"""What turns an SB3 on-policy algorithm into one that learns and uses permissibility."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar, Self, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.common.arrays import BoolArray
from sb3_sap.common.errors import check_at_least, is_number
from sb3_sap.common.extractors import with_extractor
from sb3_sap.common.reward_shaping import RewardShaping
from sb3_sap.common.saving import SavingMixin
from sb3_sap.common.schedules import as_schedule
from sb3_sap.common.signatures import merged_signature
from sb3_sap.common.spaces import check_any_action_space
from sb3_sap.common.watching import every_callback
from sb3_sap.guidance.masks import PermissibleActions, mask_source, masks_at, masks_of
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.labels import LabelCallback, shaped_rewards
from sb3_sap.onpolicy.loss import PermissibilityLoss
from sb3_sap.onpolicy.policy import GuidedPolicyMixin, guided_policy_class
from sb3_sap.onpolicy.trust import Agreement
from sb3_sap.predictor.building import make_knowledge
from sb3_sap.predictor.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.labelling import LabelledTransitions
from sb3_sap.predictor.schedule import weighted_labels
from sb3_sap.predictor.transfer import PriorKnowledgeMixin

#: Maximum number of combinations of a MultiDiscrete or MultiBinary action, each of which E judges in each state.
MOST_COMBINATIONS = 4_096


class OnPolicyPermissibilityMixin(PriorKnowledgeMixin, SavingMixin, OnPolicyAlgorithm):
    """Guides an SB3 on-policy algorithm with a learned AP predictor E.

    Goes before the algorithm in the bases of a class. E is fixed while a rollout is collected, and then fitted, in
    proportion to the new labels. While it is accurate, its verdicts restrict the rollout:

    - Finite actions are masked. Log-probabilities and entropy are those of the masked distribution, in the update
      with the same masks. For ``MultiDiscrete`` and ``MultiBinary`` actions E judges each combination.
    - Of continuous actions, the first of some draws from the policy that E permits is executed
      (:meth:`~sb3_sap.onpolicy.guide.Guide.first_permissible`).

    Where E permits nothing everything is permitted. ``predict`` is the policy alone unless ``guided=True`` is passed.
    The further parameters are those of :class:`~sb3_sap.predictor.transfer.PriorKnowledgeMixin` and of the base
    algorithm, whose ``learning_rate`` and ``clip_range`` may also be ``"lin_<number>"``. A recurrent policy has a
    memory; E sees the observation alone.

    :param alpha: 1: E guides once its balanced validation accuracy is 70 %; 0: never
    :param n_candidates: number of draws from a policy of continuous actions
    :param predictor_epochs: how often, on average, fits of E see each labelled action, like ``n_epochs`` of PPO; the
        first 2,000 count eight times (:func:`~sb3_sap.predictor.schedule.weighted_labels`)
    :param permissibility_coef: β of a loss towards permissible actions within the updates of the policy
        (:func:`~sb3_sap.onpolicy.loss.losses`), in units of the advantages: a number, a schedule, or ``"lin_2.0"``. It
        is multiplied by the agreement of labels and advantages (:class:`~sb3_sap.onpolicy.trust.Agreement`), so that
        it fades by itself, and is applied while E is accurate, whatever ``alpha``
    :param permissible_actions: for finite actions, a :class:`~sb3_sap.guidance.masks.PermissibleActions` or its dotted
        name, or the key of a mask in a ``Dict`` observation
        (:class:`~sb3_sap.guidance.mask_wrapper.ActionMaskObservation`). What it does not allow has probability 0, in
        the rollout, the update and ``predict``; where it allows nothing, everything is. Labels are then optional
    """

    _of_this_process: ClassVar[tuple[str, ...]] = (
        "_label_callback",
        "_fit_callback",
        "_rollout_guide",
        "_permissible_actions",
    )
    held: ClassVar[tuple[str, ...]] = ("use_sde",)
    #: Settings that may be numbers, schedules or ``"lin_<number>"``.
    schedules: ClassVar[tuple[str, ...]] = ("learning_rate", "clip_range", "permissibility_coef")
    #: E must not change within a rollout, however often the callback is called.
    fits_in_train: ClassVar[bool] = True

    def __init__(
        self,
        policy: Any,
        env: Any,
        *args: Any,
        alpha: float = 1.0,
        n_candidates: int = 32,
        predictor_epochs: float = 5,
        permissibility_coef: float | Schedule | str = 0.0,
        permissible_actions: PermissibleActions | str | None = None,
        **kwargs: Any,
    ):
        if kwargs.get("risk_discount") is not None:
            raise ValueError(
                f"`risk_discount` is for off-policy algorithms, and {type(self).__name__} learns from its last rollout "
                "alone: give the `event` a `horizon` instead."
            )
        self.alpha = alpha
        self.n_candidates = n_candidates
        self.predictor_epochs = predictor_epochs
        self.permissibility_coef: Any = permissibility_coef
        self.permissible_actions = permissible_actions
        #: Holds K; saved with the model.
        self.labelled = cast(LabelledTransitions, None)
        #: Of the labels with the advantages of the last rollouts.
        self.agreement = Agreement()
        self._rollout_guide: Guide | None = None  # of the rollout in progress, and thus of its update
        self._labels_seen = 0  # labels that fits of E are due for or were made for
        self._examples_due = 0.0  # examples that E has yet to see
        self._label_callback = LabelCallback()
        self._fit_callback: PermissibilityCallback | None = None
        kwargs["policy_kwargs"] = with_extractor(kwargs.get("policy_kwargs"))
        super().__init__(policy, env, *args, **kwargs)

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        if any(base is OffPolicyAlgorithm for base in cls.__mro__):
            raise TypeError(
                f"{cls.__name__} puts {cls.__bases__[0].__name__} before an off-policy algorithm: choose an on-policy "
                "one, such as PPO, or put ActionPermissibilityMixin before it."
            )
        # The constructors pass *args and **kwargs on; editors and API pages should show the whole list.
        cls.__signature__ = merged_signature(cls)  # type: ignore[attr-defined]

    def _check_action_space(self, space: spaces.Space[Any]) -> None:
        check_any_action_space(type(self).__name__, space, MOST_COMBINATIONS)

    def _setup_model(self) -> None:
        self._check_settings()
        self._permissible_actions = mask_source(self.permissible_actions, self.observation_space, self.action_space)
        for name in self.schedules:
            if hasattr(self, name):
                setattr(self, name, as_schedule(getattr(self, name), name))
        loaded = self.labelled is not None
        if not loaded:
            self._check_knowledge_settings()
            self.labelled = LabelledTransitions(make_knowledge(self))
        elif self.knowledge.size != self.knowledge_buffer_size:
            raise ValueError(
                f"`knowledge_buffer_size` = {self.knowledge_buffer_size} cannot be changed by `load`, because the file "
                f"holds a knowledge buffer of {self.knowledge.size}: leave it out, or build a new "
                f"{type(self).__name__}."
            )
        rng = self.knowledge.rng
        plain = self.policy_class
        # Files hold the plain class, which SB3 and other code know.
        self.policy_class = guided_policy_class(cast(type[ActorCriticPolicy], plain))
        try:
            super()._setup_model()
        finally:
            self.policy_class = plain
        if loaded:
            self.knowledge.rng = rng  # SB3 has applied the seed anew
        self._set_label_source(self.labelled)

    def _check_settings(self) -> None:
        if isinstance(self.alpha, bool) or self.alpha not in (0, 1):
            raise ValueError(
                f"`alpha` is 1 (E guides once it is accurate) or 0 (it never does), because the update must know the "
                f"masks, but is {self.alpha!r}."
            )
        check_at_least(self, n_candidates=1, horizon=1)
        if self.horizon > self.n_steps and RewardShaping(self.penalty).penalises:
            raise ValueError(
                f"`penalty` = {self.penalty!r} with `horizon` = {self.horizon} would come after the end of rollouts of "
                f"`n_steps` = {self.n_steps}: raise `n_steps`, or leave the penalty out."
            )
        if self.permissible_actions is not None and isinstance(self.action_space, spaces.Box):
            raise ValueError(
                f"`permissible_actions` of an on-policy algorithm masks finite actions, but the action space is "
                f"{self.action_space}: choose an off-policy algorithm, such as SACAP, or let the environment clip."
            )
        epochs: Any = self.predictor_epochs
        coef = self.permissibility_coef
        if not (is_number(epochs) and 0 <= float(epochs) < np.inf):
            raise ValueError(f"`predictor_epochs` must be a number of at least 0, but is {epochs!r}.")
        if is_number(coef) and not float(coef) >= 0:
            raise ValueError(f"`permissibility_coef` must be at least 0, but is {coef!r}.")

    @property
    def knowledge(self) -> KnowledgeBuffer:
        """K, which is saved with the model."""
        return self.labelled.knowledge

    def _holds_knowledge(self) -> bool:
        return self.labelled is not None

    def _label_holder(self) -> LabelledTransitions:
        return self.labelled

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None and self._holds_knowledge():
            self.knowledge.seed(seed)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._set_label_source(self.labelled)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._of_this_process]

    # ---------------------------------------------------------------- learning

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

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, rollout_buffer: Any, n_rollout_steps: int) -> Any:
        """SB3's ``collect_rollouts``, guided while E is accurate, with the labels' share in the stored rewards."""
        asks = bool(self.alpha) and self._judges
        # Of K's generator, which is saved with the model.
        draws = asks and isinstance(self.action_space, spaces.Box)
        seed = int(self.knowledge.rng.integers(2**31)) if draws else 0
        guided = asks or self._permissible_actions is not None
        guide = self._rollout_guide = self._guide(asks, seed=seed) if guided else None
        self.logger.record("sap/alpha", float(asks))
        with self._guided_by(guide), shaped_rewards(rollout_buffer, self._label_callback):
            if guide is not None and self._permissible_actions is not None:
                guide.known_masks = self._masks_of_last_observations
            try:
                return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
            finally:
                if guide is not None:
                    guide.known_masks = None

    def _masks_of_last_observations(self) -> BoolArray:
        return masks_of(cast(PermissibleActions, self._permissible_actions), self.action_space, self.raw_last_obs())

    def train(self) -> None:
        """Fits of E to the new labels; then SB3's ``train``, with the masks of the rollout and the loss on E."""
        self._refit()
        labelled = self._label_callback.of_rollout(self.rollout_buffer.advantages)
        if labelled is not None:
            self.agreement.update(*labelled)
        coef = FloatSchedule(self.permissibility_coef)(self._current_progress_remaining) * float(self.agreement)
        policy = cast(GuidedPolicyMixin, self.policy)
        if coef > 0 and self._judges:
            guide = self._guide()
            if self._rollout_guide is not None:
                guide.known = self._rollout_guide.known
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

    # ---------------------------------------------------------------- guidance

    @property
    def _judges(self) -> bool:
        """Whether E is accurate enough for anything to follow its verdicts."""
        return self.predictor.fitted and self.predictor_accurate

    def _guide(self, asks: bool = True, predicts: bool = False, seed: int = 0) -> Guide:
        """:param asks: whether E is asked; else there are known masks alone."""
        predictor = self.predictor if asks else None
        squashed = self.policy.squash_output
        guide = Guide(predictor, self.action_space, self.n_candidates, squashed, self.device, predicts, seed)
        guide.logger = None if predicts else self.logger
        return guide

    @contextmanager
    def _guided_by(self, guide: Guide | None) -> Iterator[None]:
        """Within the block, the policy is guided; ``None``: it is not."""
        policy = cast(GuidedPolicyMixin, self.policy)
        before, policy.guide = policy.guide, guide
        try:
            yield
        finally:
            policy.guide = before

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray[Any, Any], ...] | None = None,
        episode_start: np.ndarray[Any, Any] | None = None,
        deterministic: bool = False,
        guided: bool = False,
    ) -> tuple[np.ndarray[Any, Any], tuple[np.ndarray[Any, Any], ...] | None]:
        """SB3's ``predict``.

        ``permissible_actions`` hold here, too.

        :param guided: restrict the policy to what E permits, as soon as E was fitted; ``alpha`` is ignored
        """
        asks, source = guided and self.predictor.fitted, self._permissible_actions
        if not asks and source is None:
            return super().predict(observation, state, episode_start, deterministic)
        guide = self._guide(asks, predicts=True)
        if source is not None:
            masks = masks_at(self, source, observation)
            guide.known_masks = lambda: masks
        with self._guided_by(guide):
            return super().predict(observation, state, episode_start, deterministic)
