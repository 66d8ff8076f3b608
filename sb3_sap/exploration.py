"""How a guided model chooses actions while training: Algorithm 1 over SB3's off-policy algorithms."""

from __future__ import annotations

import warnings
from numbers import Real
from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_sap.actor_loss import permissible_actor_step, permissible_value_step
from sb3_sap.candidates import SELECTIONS, choose, q_values
from sb3_sap.constraints import ConstrainedExplorationMixin, rows_of
from sb3_sap.growth import check_growth, due
from sb3_sap.learning import LearnedPermissibilityMixin
from sb3_sap.permissibility import FloatArray
from sb3_sap.prediction import guided_prediction
from sb3_sap.predictor import candidate_logits, flush_denormals
from sb3_sap.settings import SettingsMixin, check_at_least

#: Of so many fits of E one is left once nothing asks it any more.
FITS_AFTER_GUIDANCE = 5
#: Steps between two fits, at most, of an E that teaches in a rhythm of its own: lessons of an old one are wrong.
STEPS_BETWEEN_FITS = 15


class ActionPermissibilityMixin(LearnedPermissibilityMixin, ConstrainedExplorationMixin):
    """Guides an SB3 off-policy algorithm with a learned AP predictor (Algorithm 1).

    Goes before the algorithm in the bases of a class. ``predict`` stays the policy alone unless it is asked otherwise,
    so that every evaluation tool of SB3 measures what was learned; both buffers hold the action that was executed.

    :param alpha: α, probability of consulting E once it is good enough
    :param alpha_low: the same while E's balanced validation accuracy is below 70 % (the paper gives no value)
    :param t_k: steps with noise and without guidance, counted over the model's whole life. ``None``:
        ``learning_starts``, whose uniform random steps count inside it
    :param guidance_end: the step, counted as for ``t_k``, from which on the base algorithm acts by itself again;
        ``None``, the paper's: never. Unless ``teaching_growth`` says otherwise, it learns by itself, too, and E is
        fitted a fifth as often
    :param candidate_selection: how line 11 chooses among the permissible candidates: "random" as in the paper, the one
        "nearest" to the actor's action, the one of "highest_q", or the one that E finds "most_permissible"
    :param actor_permissibility_coef: β of the permissible actor loss, a number, a schedule or ``"lin_1.0"``; 0 is the
        paper's method (see :func:`~sb3_sap.actor_loss.permissible_actor_step`, and for finite actions
        :func:`~sb3_sap.actor_loss.permissible_value_step`). It acts while E is good enough for ``alpha``
    :param teaching_growth: as ``refit_growth``, of the actor loss and the base's updates of its actor: 0, at each of
        them, and on after ``guidance_end``, with E fitted at least every fifteen steps. ``None``: as often as E is
        fitted, as long as there is guidance

    The parameters of :class:`~sb3_sap.learning.LearnedPermissibilityMixin` and
    :class:`~sb3_sap.constraints.ConstrainedExplorationMixin` come on top.
    """

    #: Whether the policy explores by itself, so that the steps before t_k need no action noise.
    stochastic_policy: ClassVar[bool] = False
    schedules = (*SettingsMixin.schedules, "actor_permissibility_coef")

    def __init__(
        self,
        *args: Any,
        alpha: float = 0.9,
        alpha_low: float = 0.5,
        t_k: int | None = None,
        guidance_end: int | None = None,
        candidate_selection: str = "random",
        actor_permissibility_coef: float | Schedule | str = 0.0,
        teaching_growth: float | None = None,
        **kwargs: Any,
    ):
        self.alpha = alpha
        self.alpha_low = alpha_low
        self.t_k = t_k
        self.guidance_end = guidance_end
        self.candidate_selection = candidate_selection
        self.actor_permissibility_coef: Any = actor_permissibility_coef
        self.teaching_growth = teaching_growth
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        for name in ("alpha", "alpha_low"):
            probability = getattr(self, name)
            if not (isinstance(probability, Real) and 0 <= float(probability) <= 1):
                raise ValueError(f"`{name}` is a probability from 0 to 1, but is {probability!r}.")
        if self.t_k is not None:
            check_at_least(self, t_k=0)
        if self.guidance_end is not None:
            check_at_least(self, guidance_end=0)
        if self.guidance_end is not None and self.guidance_end <= self.noise_steps:
            warnings.warn(
                f"`guidance_end` = {self.guidance_end} leaves no step to guidance, which begins after "
                f"{self.noise_steps} (`t_k`, or `learning_starts` where that is None).",
                stacklevel=2,
            )
        if self.teaching_growth is not None:
            check_growth(self, "teaching_growth")
        coef = self.actor_permissibility_coef
        if isinstance(coef, Real) and not float(coef) >= 0:
            raise ValueError(f"`actor_permissibility_coef` must be at least 0, but is {coef!r}.")
        if self.candidate_selection not in SELECTIONS:
            raise ValueError(
                f"`candidate_selection` must be one of {', '.join(map(repr, SELECTIONS))}, but is "
                f"{self.candidate_selection!r}."
            )
        if self.noise_steps > self.learning_starts and self.action_noise is None and not self.stochastic_policy:
            warnings.warn(
                f"`t_k` = {self.t_k} is beyond `learning_starts` = {self.learning_starts}, but there is no "
                "`action_noise`: between the two a deterministic policy does not explore.",
                stacklevel=2,
            )
        super()._setup_model()

    @property
    def noise_steps(self) -> int:
        """t_k, or ``learning_starts`` where it was left open."""
        return self.learning_starts if self.t_k is None else self.t_k

    @property
    def guidance_ended(self) -> bool:
        """Whether the base algorithm acts by itself again."""
        return self.guidance_end is not None and self.life_steps >= self.guidance_end

    @property
    def current_alpha(self) -> float:
        """α as E's validation accuracy allows it (section 4.3)."""
        return self.alpha if self.predictor_suffices else min(self.alpha_low, self.alpha)

    @property
    def predictor_rests(self) -> bool:
        """Whether nothing asks E any more but ``predict(guided=True)``, for which it need only keep up."""
        return self.guidance_ended and self.teaching_growth is None

    def refits_due(self, before: int, now: int) -> int:
        if self.teaching_growth is not None:
            return due(self.refit_growth, before, now, apart=STEPS_BETWEEN_FITS)
        return due(self.refit_growth, before, now, one_of=FITS_AFTER_GUIDANCE if self.predictor_rests else 1)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        before = self._n_updates
        super().train(gradient_steps, batch_size)
        coef = FloatSchedule(self.actor_permissibility_coef)(self._current_progress_remaining)
        if coef == 0 or self.predictor_rests or not self.predictor_suffices:
            return
        step = permissible_value_step if self.discrete else permissible_actor_step
        if self.teaching_growth is None:
            lessons = due(self.refit_growth, before, self._n_updates)
        else:
            delay = getattr(self, "policy_delay", 1)  # of so many updates of TD3 or CrossQ one moves the actor
            lessons = due(self.teaching_growth, before // delay, self._n_updates // delay)
        for _ in range(lessons):
            loss = step(
                self if self.discrete else self.actor,
                self.predictor,
                cast(ReplayBuffer, self.replay_buffer),
                coef,
                self.predictor.batch_size,  # as many states as one gradient step of E sees
                self._vec_normalize_env,
            )
            self.logger.record_mean("sap/actor_loss", loss)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        if self.life_steps < self.noise_steps:
            return super()._sample_action(learning_starts, action_noise, n_envs)  # Alg. 1, lines 1-4
        # After t_k there is neither noise nor, in a second `learn()`, another uniform warm-up.
        if self.guidance_ended:
            return super()._sample_action(0, action_noise, n_envs)
        action, scaled = super()._sample_action(0, None, n_envs)  # Alg. 1, line 1
        if self.predictor.fitted:
            guided = self._guide(scaled)
            if guided is not None:
                return self._unscale(guided), guided
        return action, scaled

    @th.no_grad()
    @flush_denormals()
    def _guide(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
        """Lines 5 to 14 of Algorithm 1, for all environments at once.

        :param actions: (n_envs, *action_shape) the actor's actions, scaled
        :return: the same with rejected ones replaced; None where nothing changed
        """
        shape, n_envs = actions.shape, len(actions)
        actions = actions.reshape(n_envs, -1)
        self.logger.record("sap/alpha", self.current_alpha)
        consulted = np.flatnonzero(self._rng.random(n_envs) < self.current_alpha)  # Alg. 1, line 5
        self.logger.record_mean("sap/consultation_rate", len(consulted) / n_envs)
        if len(consulted) == 0:
            return None
        obs, _ = self.policy.obs_to_tensor(cast(Any, self._last_obs))
        features = self.predictor.features(obs)
        logits = self.predictor.logits(features[consulted], th.as_tensor(actions[consulted], device=self.device))
        rejected = consulted[(logits <= 0).cpu().numpy()]  # Alg. 1, lines 6-7
        self.logger.record_mean("sap/rejection_rate", len(rejected) / len(consulted))
        if len(rejected) == 0:
            return None
        candidates, allowed = self._candidates(rejected, n_envs)  # Alg. 1, line 8
        verdicts = candidate_logits(self.predictor, features[rejected], candidates)
        permissible = allowed & (verdicts > 0)  # Alg. 1, line 9
        found = permissible.any(axis=1)  # Alg. 1, line 10
        self.logger.record_mean("sap/fallback_rate", 1 - found.mean())
        if not found.any():
            return None
        rows = rejected[found]
        scores = self._scores(rows_of(obs, rows), actions[rows], candidates[found], verdicts[found])
        guided = actions.copy()
        guided[rows] = choose(self._rng, candidates[found], permissible[found], scores)  # Alg. 1, line 11
        return guided.reshape(shape)

    def _scores(self, obs: Any, actions: Any, candidates: Any, logits: FloatArray) -> FloatArray | None:
        """What ``candidate_selection`` chooses by, (m, N); None at random."""
        if self.candidate_selection == "random":
            return None
        if self.candidate_selection == "most_permissible":
            return logits
        if self.candidate_selection == "nearest":
            return np.asarray(-np.linalg.norm(candidates - actions[:, None], axis=2))
        m, n, dim = candidates.shape
        every = rows_of(obs, np.repeat(np.arange(m), n))
        q = q_values(self, every, th.as_tensor(candidates.reshape(m * n, dim), device=self.device))
        return q.cpu().numpy().reshape(m, n)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray[Any, Any], ...] | None = None,
        episode_start: np.ndarray[Any, Any] | None = None,
        deterministic: bool = False,
        guided: bool = False,
    ) -> tuple[np.ndarray[Any, Any], tuple[np.ndarray[Any, Any], ...] | None]:
        """SB3's ``predict``.

        :param guided: replace an action that ``permissible_actions`` or E rejects by the nearest that they accept
            (:func:`~sb3_sap.prediction.guided_prediction`)
        """
        actions, state = super().predict(observation, state, episode_start, deterministic)
        return (guided_prediction(self, observation, actions) if guided else actions), state
