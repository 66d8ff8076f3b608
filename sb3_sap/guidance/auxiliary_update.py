"""When the auxiliary permissibility loss is applied, beside the base algorithm's updates (not in the paper)."""

from __future__ import annotations

from numbers import Real
from typing import Any, cast

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_sap.common.settings import SettingsMixin
from sb3_sap.guidance.algorithm1 import GuidedExplorationMixin
from sb3_sap.guidance.auxiliary_loss import permissible_actor_step, permissible_value_step
from sb3_sap.predictor.schedule import check_growth, due

#: After guidance ends, refit the predictor only every n-th time.
FITS_AFTER_GUIDANCE = 5
#: Maximum number of timesteps between two fits while the auxiliary loss has a schedule of its own: a stale classifier
#: biases the actor.
STEPS_BETWEEN_FITS = 15


class AuxiliaryLossMixin(GuidedExplorationMixin):
    """Adds an auxiliary loss to the actor, or for discrete actions to the Q-values.

    :param actor_permissibility_coef: β of the auxiliary loss, a number, a schedule or ``"lin_1.0"``; 0 is the paper's
        method (see :func:`~sb3_sap.guidance.auxiliary_loss.permissible_actor_step`, and for discrete actions
        :func:`~sb3_sap.guidance.auxiliary_loss.permissible_value_step`). It is applied while E is accurate enough for
        ``alpha``
    :param teaching_growth: like ``refit_growth``, for the auxiliary loss, counted in actor updates; 0: after every
        update. The loss then continues after ``guidance_end``, and E is refitted at least every fifteen steps.
        ``None``: as often as E is fitted, until ``guidance_end``
    """

    schedules = (*SettingsMixin.schedules, "actor_permissibility_coef")

    def __init__(
        self,
        *args: Any,
        actor_permissibility_coef: float | Schedule | str = 0.0,
        teaching_growth: float | None = None,
        **kwargs: Any,
    ):
        self.actor_permissibility_coef: Any = actor_permissibility_coef
        self.teaching_growth = teaching_growth
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        if self.teaching_growth is not None:
            check_growth(self, "teaching_growth")
        coef = self.actor_permissibility_coef
        if isinstance(coef, Real) and not float(coef) >= 0:
            raise ValueError(f"`actor_permissibility_coef` must be at least 0, but is {coef!r}.")
        super()._setup_model()

    @property
    def predictor_idle(self) -> bool:
        """True once the predictor is used only by ``predict(guided=True)``."""
        return self.guidance_ended and self.teaching_growth is None

    def refits_due(self, before: int, now: int) -> int:
        if self.teaching_growth is not None:
            return due(self.refit_growth, before, now, max_gap=STEPS_BETWEEN_FITS)
        return due(self.refit_growth, before, now, every=FITS_AFTER_GUIDANCE if self.predictor_idle else 1)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        before = self._n_updates
        super().train(gradient_steps, batch_size)
        coef = FloatSchedule(self.actor_permissibility_coef)(self._current_progress_remaining)
        if coef == 0 or self.predictor_idle or not self.predictor_accurate:
            return
        if self.teaching_growth is None:
            updates = due(self.refit_growth, before, self._n_updates)
        else:
            # TD3 and CrossQ update the actor once every `policy_delay` critic updates.
            delay = getattr(self, "policy_delay", 1)
            updates = due(self.teaching_growth, before // delay, self._n_updates // delay)
        for _ in range(updates):
            # As many states as one gradient step of E.
            batch = cast(ReplayBuffer, self.replay_buffer).sample(self.predictor.batch_size, self._vec_normalize_env)
            self.logger.record_mean("sap/auxiliary_loss", self._permissible_step(batch.observations, coef))

    def _permissible_step(self, observations: Any, coef: float) -> float:
        step = permissible_value_step if self.discrete else permissible_actor_step
        return step(self if self.discrete else self.actor, self.predictor, observations, coef)
