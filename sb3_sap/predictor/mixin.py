"""Adds labels, the knowledge buffer K (saved with the replay buffer) and the AP predictor E (saved with the model)."""

from __future__ import annotations

import math
from typing import Any, cast

from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.common.errors import check_at_least
from sb3_sap.common.settings import SettingsMixin
from sb3_sap.predictor.buffers import KnowledgeMixin, check_fits
from sb3_sap.predictor.building import make_replay_buffer
from sb3_sap.predictor.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.predictor.importing import Into
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.labelling import Labels
from sb3_sap.predictor.prior_replay import PriorReplay
from sb3_sap.predictor.risk_mixin import LearnedRiskMixin
from sb3_sap.predictor.schedule import check_growth, due
from sb3_sap.transitions.sources import number_of_rows


class LearnedPermissibilityMixin(LearnedRiskMixin, SettingsMixin):
    """Gives an SB3 off-policy algorithm a knowledge buffer K and an AP predictor E (section 4.2).

    Only trains the predictor; action selection and policy updates are those of the base algorithm.
    The further parameters are those of :class:`~sb3_sap.predictor.risk_mixin.LearnedRiskMixin`.

    :param refit_growth: refit and validate E when the step count has grown by this fraction, because a few new
        examples change it less and less, while a fit costs the same; 0 (paper): every step, or as often as
        ``predictor_gradient_steps`` says
    :param predictor_gradient_steps: maximum number of fits after each rollout, like ``gradient_steps`` of the base
        algorithm; -1: one for each vectorised step. ``None``: as many as the base's gradient steps, which for DQN
        are fewer than its timesteps; no maximum if ``refit_growth`` is above 0
    """

    def __init__(
        self,
        *args: Any,
        refit_growth: float = 0.0,
        predictor_gradient_steps: int | None = None,
        **kwargs: Any,
    ):
        self.refit_growth = refit_growth
        self.predictor_gradient_steps = predictor_gradient_steps
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        self._check_knowledge_settings()
        check_growth(self, "refit_growth")
        if self.predictor_gradient_steps is not None:
            check_at_least(self, predictor_gradient_steps=-1)
        if self.replay_buffer is None:
            self.replay_buffer = make_replay_buffer(self)
        # SB3 warns of a buffer class together with `n_steps`, which the buffer above has been given.
        self.replay_buffer_class = None
        # SB3 writes `n_steps` and `gamma` into this dictionary, where they would override those of a later `load`.
        given, self.replay_buffer_kwargs = self.replay_buffer_kwargs, dict(self.replay_buffer_kwargs)
        super()._setup_model()
        self.replay_buffer_kwargs = given
        self.replay_buffer_class = type(self.replay_buffer)
        self._set_label_source(cast(KnowledgeMixin, self.replay_buffer))

    @property
    def knowledge(self) -> KnowledgeBuffer:
        """K, which is filled by the replay buffer and saved with it."""
        return cast(KnowledgeMixin, self.replay_buffer).knowledge

    def _holds_knowledge(self) -> bool:
        return isinstance(self.replay_buffer, KnowledgeMixin)

    def _label_holder(self) -> Labels:
        return cast(KnowledgeMixin, self.replay_buffer)

    def _new_replay(self, into: Into | None, source: Any) -> PriorReplay | None:
        if into == "knowledge":
            return None
        return PriorReplay(self, into is not None, number_of_rows(source))

    def _set_label_source(self, holder: Labels) -> None:
        super()._set_label_source(holder)
        cast(KnowledgeMixin, holder).prior_share = self.prior_share
        for buffer in getattr(holder, "prior", ()):
            super()._set_label_source(buffer)
            buffer.reward_scale = holder.reward_scale
            if isinstance(buffer, HerReplayBuffer) and buffer.env is None and self.env is not None:
                buffer.set_env(self.env)
        if holder.shaping.penalises and holder.pending is not None and isinstance(holder, HerReplayBuffer):
            raise ValueError(
                f"`penalty` = {self.penalty!r} with `horizon` above 1 or an `event` cannot be combined with "
                f"{type(holder).__name__}, because a hindsight goal would need labels of its own: leave the penalty "
                "out, or use an `ap_function` of single steps."
            )
        if holder.shaping.penalises and holder.ap_function is None and isinstance(holder, HerReplayBuffer):
            raise ValueError(
                f"`penalty` = {self.penalty!r} needs an `ap_function` beside {type(holder).__name__}, for a hindsight "
                'goal has no label in `info["permissible"]`: pass the AP function itself.'
            )

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None and self._holds_knowledge():
            self.knowledge.seed(seed)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Added here, because a user who forgot it would silently train the unguided algorithm.
        if not contains_permissibility_callback(callback):
            if not isinstance(callback, (list, BaseCallback)):
                callback = ConvertCallback(callback)
            callback = [PermissibilityCallback(), *(callback if isinstance(callback, list) else [callback])]
        return super()._init_callback(callback, progress_bar)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        # The buffer of a copied model has lost its AP function.
        self._set_label_source(cast(KnowledgeMixin, self.replay_buffer))
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def refits_due(self, before: int, now: int) -> int:
        """The number of fits that are due for the vectorised steps after ``before``, up to ``now``."""
        return due(self.refit_growth, before, now)

    @property
    def fits_per_rollout(self) -> float:
        """The maximum number of fits after a rollout."""
        steps: float | None = self.predictor_gradient_steps
        if steps is None:
            # At least one, for a base algorithm that does not train at all.
            steps = max(1, self.gradient_steps) if self.refit_growth == 0 <= self.gradient_steps else -1
        return steps if steps >= 0 else math.inf

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._set_label_source(cast(KnowledgeMixin, self.replay_buffer))

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        previous = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded, self.replay_buffer = self.replay_buffer, previous  # which is kept if the check fails
        check_fits(cast(Any, loaded), self)
        self.replay_buffer = loaded
        self._set_label_source(cast(KnowledgeMixin, loaded))
