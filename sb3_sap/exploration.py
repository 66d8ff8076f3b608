"""How a guided model chooses actions while training: Algorithm 1 over SB3's off-policy algorithms."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_sap.actor_loss import permissible_actor_step
from sb3_sap.constraints import ConstrainedExplorationMixin
from sb3_sap.learning import LearnedPermissibilityMixin
from sb3_sap.permissibility import FloatArray
from sb3_sap.predictor import flush_denormals


class ActionPermissibilityMixin(LearnedPermissibilityMixin, ConstrainedExplorationMixin):
    """Guides an SB3 off-policy algorithm with a learned AP predictor (Algorithm 1).

    Goes before the algorithm in the bases of a class. ``predict`` stays the policy alone, so that every evaluation
    tool of SB3 measures what was learned; both buffers hold the action that was executed.

    :param alpha: α, probability of consulting E once it is good enough
    :param alpha_low: the same while E's balanced validation accuracy is below 70 % (the paper gives no value)
    :param t_k: steps with noise and without guidance, counted over the model's whole life. ``None``:
        ``learning_starts``, whose uniform random steps count inside it
    :param n_candidates: N of line 8, the size of A_st
    :param actor_permissibility_coef: β of the permissible actor loss, a number or an SB3 schedule; 0 is the paper's
        method (see :func:`~sb3_sap.actor_loss.permissible_actor_step`). It acts while E is good enough for ``alpha``

    The parameters of :class:`~sb3_sap.learning.LearnedPermissibilityMixin` and
    :class:`~sb3_sap.constraints.ConstrainedExplorationMixin` come on top.
    """

    #: Whether the policy explores by itself, so that the steps before t_k need no action noise.
    stochastic_policy: ClassVar[bool] = False

    def __init__(
        self,
        *args: Any,
        alpha: float = 0.9,
        alpha_low: float = 0.5,
        t_k: int | None = None,
        n_candidates: int = 128,
        actor_permissibility_coef: float | Schedule = 0.0,
        **kwargs: Any,
    ):
        self.alpha = alpha
        self.alpha_low = alpha_low
        self.t_k = t_k
        self.n_candidates = n_candidates
        self.actor_permissibility_coef = actor_permissibility_coef
        self._steps_of_earlier_learns = 0
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        for name in ("alpha", "alpha_low"):
            probability = getattr(self, name)
            if not (isinstance(probability, (int, float)) and 0 <= probability <= 1):
                raise ValueError(f"`{name}` is a probability from 0 to 1, but is {probability!r}.")
        if self.t_k is not None and self.t_k < 0:
            raise ValueError(f"`t_k` is a number of steps, 0 or more, but is {self.t_k}.")
        self._check_at_least(n_candidates=1)
        if self.noise_steps > self.learning_starts and self.action_noise is None and not self.stochastic_policy:
            warnings.warn(
                f"`t_k` = {self.t_k} is beyond `learning_starts` = {self.learning_starts}, but there is no "
                "`action_noise`: between the two a deterministic policy does not explore.",
                stacklevel=2,
            )
        super()._setup_model()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps:
            self._steps_of_earlier_learns += self.num_timesteps
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    @property
    def noise_steps(self) -> int:
        """t_k, or ``learning_starts`` where it was left open."""
        return self.learning_starts if self.t_k is None else self.t_k

    @property
    def current_alpha(self) -> float:
        """α as E's validation accuracy allows it (section 4.3)."""
        return self.alpha if self.predictor_suffices else min(self.alpha_low, self.alpha)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        super().train(gradient_steps, batch_size)
        coef = FloatSchedule(self.actor_permissibility_coef)(self._current_progress_remaining)
        if coef == 0 or not self.predictor_suffices:
            return
        for _ in range(gradient_steps):
            loss = permissible_actor_step(
                self.actor,
                self.predictor,
                cast(ReplayBuffer, self.replay_buffer),
                coef,
                batch_size,
                self._vec_normalize_env,
            )
            self.logger.record_mean("sap/actor_loss", loss)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        if self._steps_of_earlier_learns + self.num_timesteps < self.noise_steps:
            return super()._sample_action(learning_starts, action_noise, n_envs)  # Alg. 1, lines 1-4
        # After t_k there is neither noise nor, in a second `learn()`, another uniform warm-up.
        action, scaled = super()._sample_action(0, None, n_envs)  # Alg. 1, line 1
        if self.predictor.fitted:
            guided = self._guide(scaled)
            if guided is not None:
                return self.policy.unscale_action(guided), guided
        return action, scaled

    @th.no_grad()
    @flush_denormals()
    def _guide(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
        """Lines 5 to 14 of Algorithm 1, for all environments at once.

        :param actions: (n_envs, *action_shape) the actor's actions, scaled
        :return: the same with rejected ones replaced; None where nothing changed
        """
        shape, actions = actions.shape, actions.reshape(len(actions), -1)
        self.logger.record("sap/alpha", self.current_alpha)
        consulted = np.flatnonzero(self._rng.random(len(actions)) < self.current_alpha)  # Alg. 1, line 5
        self.logger.record_mean("sap/consultation_rate", len(consulted) / len(actions))
        if len(consulted) == 0:
            return None
        obs, _ = self.policy.obs_to_tensor(cast(Any, self._last_obs))
        features = self.predictor.features(obs)
        logits = self.predictor.logits(features[consulted], th.as_tensor(actions[consulted], device=self.device))
        rejected = consulted[(logits <= 0).cpu().numpy()]  # Alg. 1, lines 6-7
        self.logger.record_mean("sap/rejection_rate", len(rejected) / len(consulted))
        if len(rejected) == 0:
            return None
        low, high = (b.reshape(actions.shape)[rejected] for b in self._allowed_interval(len(actions)))
        candidates = stratified_candidates(self._rng, low, high, self.n_candidates)  # Alg. 1, line 8
        permissible = self._permissible(features[rejected], candidates)  # Alg. 1, line 9
        found = permissible.any(axis=1)  # Alg. 1, line 10
        self.logger.record_mean("sap/fallback_rate", 1 - found.mean())
        guided = actions.copy()
        for i in np.flatnonzero(found):
            guided[rejected[i]] = self._rng.choice(candidates[i, permissible[i]])  # Alg. 1, line 11
        return guided.reshape(shape)

    def _permissible(self, features: th.Tensor, candidates: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """E's verdict on (n, N, action_dim) candidates for (n, features_dim) features: (n, N) bool."""
        n, n_candidates, _ = candidates.shape
        actions = th.as_tensor(candidates, device=self.device).flatten(0, 1)
        logits = self.predictor.logits(features.repeat_interleave(n_candidates, dim=0), actions)
        return (logits > 0).cpu().numpy().reshape(n, n_candidates)


def stratified_candidates(rng: np.random.Generator, low: FloatArray, high: FloatArray, n: int) -> FloatArray:
    """Low-variance uniform sampling (section 4.3): one draw from each of n equal strata of every dimension.

    In one dimension the candidates come in ascending order; in more, the strata of the dimensions are paired at
    random, which is Latin hypercube sampling.

    :param low: (m, action_dim) lower bounds
    :param high: (m, action_dim) upper bounds
    :return: (m, n, action_dim) candidates, float32
    """
    m, dim = low.shape
    strata = np.broadcast_to(np.arange(n)[:, None], (m, n, dim))
    if dim > 1:
        strata = rng.permuted(strata, axis=1)
    unit = (strata + rng.random((m, n, dim))) / n  # (m, n, action_dim) in [0, 1)
    return (low[:, None] + unit * (high - low)[:, None]).astype(np.float32)
