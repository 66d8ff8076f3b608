"""When the auxiliary permissibility loss is applied, beside the base algorithm's updates (not in the paper)."""

from __future__ import annotations

import copy
import itertools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Real
from typing import Any, cast

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_sap.common.settings import SettingsMixin
from sb3_sap.guidance.algorithm1 import GuidedExplorationMixin
from sb3_sap.guidance.auxiliary_loss import permissible_actor_step, permissible_value_step
from sb3_sap.guidance.teaching import cloning_step, taught_step
from sb3_sap.predictor.network import SUFFICIENT_ACCURACY
from sb3_sap.predictor.schedule import check_growth, due

#: After guidance ends, refit the predictor only every n-th time.
FITS_AFTER_GUIDANCE = 5
#: Maximum number of timesteps between two fits while the auxiliary loss has a schedule of its own: a stale classifier
#: biases the actor.
STEPS_BETWEEN_FITS = 15

#: Networks that are held still together.
ACTORS = ("actor", "actor_target")
#: Networks of the policy, and those of the target that follow them.
TARGETS = (("actor", "actor_target"), ("q_net", "q_net_target"), ("quantile_net", "quantile_net_target"))


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
        #: Timestep, counted like ``t_k``, up to which a taught actor stays as it is; -1: it does not.
        self.held_until = -1
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
        with self._held_still():
            self._train(gradient_steps, batch_size)

    @contextmanager
    def _held_still(self) -> Iterator[None]:
        """Within the block, whatever changes a taught actor that is held is undone at the end."""
        if self.lifetime_steps > self.held_until:
            yield
            return
        policy: Any = self.policy
        held = {name: copy.deepcopy(getattr(policy, name).state_dict()) for name in ACTORS if hasattr(policy, name)}
        yield
        for name, state in held.items():
            getattr(policy, name).load_state_dict(state)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
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

    def teach_policy(self, steps: int = 1_000, hold: int = 0, imitate: bool | None = None) -> float:
        """Teaches the policy what is permissible, before the first step.

        A continuous actor imitates the permissible actions of :meth:`add_knowledge`, or else of K. If there are none,
        it moves to what E permits, no further than it demands (:func:`~sb3_sap.guidance.teaching.taught_step`), in the
        states that came with the predictor. The values of discrete actions learn to prefer what E permits
        (:func:`~sb3_sap.guidance.auxiliary_loss.preference_loss`). Target networks follow.

        :param steps: gradient steps
        :param hold: timesteps from now on for which a continuous actor stays as it was taught, while the critics learn
            what its actions are worth: at first they would lead it astray
        :param imitate: whether a continuous actor imitates, or is taught by E whatever is known. ``None``: it imitates
            if permissible actions are known
        :return: the mean loss of the last tenth of them
        :raise ValueError: if no state is known, or E was not fitted; to imitate, if no permissible action is known
        """
        if steps < 1:
            raise ValueError(f"`steps` must be at least 1, but is {steps!r}.")
        if imitate and self.discrete:
            raise ValueError("`imitate` needs continuous actions: leave it out.")
        if imitate is None:
            imitate = not self.discrete and self.knows_permissible
        if not imitate and self.predictor.fitted and not self.predictor_accurate:
            warnings.warn(
                f"The AP predictor teaches the policy, but its balanced accuracy is {self.validation_accuracy:.0%}, "
                f"below the {SUFFICIENT_ACCURACY:.0%} from which its verdicts are trusted: give it more labelled "
                "actions and call `fit_predictor` first.",
                stacklevel=2,
            )
        losses, n = [], self.predictor.batch_size
        lessons: Any = self.known_actions(n) if imitate else self.known_states(n)
        for lesson in itertools.islice(lessons, steps):
            if imitate:
                losses.append(cloning_step(self.actor, *lesson))
            elif self.discrete:
                losses.append(self._permissible_step(lesson, 1.0))
            else:
                losses.append(taught_step(self.actor, self.predictor, lesson))
        for own, target in TARGETS:
            if getattr(self, own, None) is not None and getattr(self, target, None) is not None:
                getattr(self, target).load_state_dict(getattr(self, own).state_dict())
        self.held_until = self.lifetime_steps + hold if hold > 0 and not self.discrete else -1
        return float(np.mean(losses[-max(1, steps // 10) :]))
