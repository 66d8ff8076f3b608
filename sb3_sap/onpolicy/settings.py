"""The settings of a guided on-policy algorithm: what its constructor takes, checks, saves and seeds."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_sap.common.errors import check_at_least, is_number
from sb3_sap.common.extractors import with_extractor
from sb3_sap.common.reward_shaping import RewardShaping
from sb3_sap.common.saving import SavingMixin
from sb3_sap.common.schedules import as_schedule
from sb3_sap.common.spaces import check_any_action_space
from sb3_sap.guidance.masks import PermissibleActions, mask_source
from sb3_sap.onpolicy.choosing import check_combinations
from sb3_sap.onpolicy.policy import guided_policy_class
from sb3_sap.predictor.building import make_knowledge
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.labelling import LabelledTransitions
from sb3_sap.predictor.transfer import PriorKnowledgeMixin


class OnPolicySettingsMixin(PriorKnowledgeMixin, SavingMixin, OnPolicyAlgorithm):
    """Holds the settings of guidance, and K.

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

    _of_this_process: ClassVar[tuple[str, ...]] = ("_permissible_actions",)
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
        kwargs["policy_kwargs"] = with_extractor(kwargs.get("policy_kwargs"))
        super().__init__(policy, env, *args, **kwargs)

    def _check_action_space(self, space: spaces.Space[Any]) -> None:
        check_any_action_space(type(self).__name__, space)

    def _setup_model(self) -> None:
        self._permissible_actions = mask_source(self.permissible_actions, self.observation_space, self.action_space)
        self._check_settings()
        check_combinations(self.action_space, self.parts, self._permissible_actions)
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
