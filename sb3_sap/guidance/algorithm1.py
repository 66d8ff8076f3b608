"""Algorithm 1: how a guided model chooses actions while it trains."""

from __future__ import annotations

import warnings
from numbers import Real
from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise

from sb3_sap.common.arrays import FloatArray, rows_of
from sb3_sap.common.errors import check_at_least
from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.candidates import SELECTIONS, choose, only_in
from sb3_sap.guidance.constrained import ConstrainedExplorationMixin
from sb3_sap.guidance.values import q_values
from sb3_sap.predictor.mixin import LearnedPermissibilityMixin
from sb3_sap.predictor.pairs import query_candidates


class GuidedExplorationMixin(LearnedPermissibilityMixin, ConstrainedExplorationMixin):
    """Explores with the AP predictor E (Algorithm 1).

    :param alpha: α, probability of querying E once it is accurate enough; with 0 the base algorithm explores, with its
        own noise, throughout
    :param alpha_low: the same while E's balanced validation accuracy is below 70 % (the paper gives no value)
    :param t_k: timesteps with noise and without guidance, counted over the model's whole life, the uniform random
        steps of ``learning_starts`` included. ``None``: ``learning_starts``
    :param guidance_end: timestep after which exploration is unguided, counted like ``t_k``; ``None`` (paper): never.
        Unless ``teaching_growth`` is set, the auxiliary actor loss ends with it, and E is refitted only every
        fifth time
    :param candidate_selection: how line 11 chooses among the permissible candidates: ``"random"`` (paper),
        ``"nearest"`` to the actor's action, ``"highest_q"``, or ``"most_permissible"`` according to E
    """

    #: Whether the algorithm explores by itself (stochastic or ε-greedy), so that steps before t_k need no action noise.
    explores_without_noise: ClassVar[bool] = False

    def __init__(
        self,
        *args: Any,
        alpha: float = 0.9,
        alpha_low: float = 0.5,
        t_k: int | None = None,
        guidance_end: int | None = None,
        candidate_selection: str = "random",
        **kwargs: Any,
    ):
        self.alpha = alpha
        self.alpha_low = alpha_low
        self.t_k = t_k
        self.guidance_end = guidance_end
        self.candidate_selection = candidate_selection
        super().__init__(*args, **kwargs)

    # ------------------------------------------------------------- Algorithm 1

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """The actions a_t of all environments, in their units and scaled, each (n_envs, *action_shape)."""
        if self.lifetime_steps < self.noise_steps:
            # The base algorithm explores: a_t = μ(s_t) + N_t                                  # lines 1-4
            return super()._sample_action(learning_starts, action_noise, n_envs)
        if self.guidance_ended or self.alpha == 0:  # beyond the paper
            return super()._sample_action(0, action_noise, n_envs)
        # From t_k on without noise, and in a second `learn()` without another uniform warm-up: a_t = μ(s_t)
        actions, scaled = super()._sample_action(0, None, n_envs)  # line 1
        if self.predictor.fitted:
            guided = self.guide(scaled)  # lines 5-14
            if guided is not None:
                return self.unscale_actions(guided), guided
        return actions, scaled  # line 15

    @th.no_grad()
    @flush_denormals()
    def guide(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
        """Lines 5 to 14 of Algorithm 1, for all environments at once.

        :param actions: (n_envs, *action_shape) the actor's actions, scaled
        :return: the same with rejected ones replaced; None where nothing changed
        """
        shape = actions.shape
        guided = actions.reshape(len(actions), -1)
        changed = False
        for part in self.predictor.judged_parts if self.parts else (None,):
            repaired = self._guide_part(guided, part)
            if repaired is not None:
                guided, changed = repaired, True
        return guided.reshape(shape) if changed else None

    def _guide_part(self, actions: np.ndarray[Any, Any], part: int | None) -> np.ndarray[Any, Any] | None:
        """The same for one part of the action, whose other dimensions remain; None: for the whole action.

        :param actions: (n_envs, action_dim), scaled
        """
        n_envs = len(actions)
        alpha = self._alpha_of(part)
        self.logger.record("sap/alpha", alpha)
        consulted = np.flatnonzero(self.exploration_rng.random(n_envs) < alpha)  # line 5
        self.logger.record_mean("sap/consultation_rate", len(consulted) / n_envs)
        if len(consulted) == 0:
            return None
        obs, _ = self.policy.obs_to_tensor(cast(Any, self._last_obs))
        features = self.predictor.features(obs)
        logits = query_candidates(self.predictor, features[consulted], actions[consulted, None], part)[:, 0]  # line 6
        rejected = consulted[logits <= 0]  # line 7
        self.logger.record_mean("sap/rejection_rate", len(rejected) / len(consulted))
        if len(rejected) == 0:
            return None
        candidates, allowed = self.sample_candidates(rejected, n_envs)  # line 8
        if part is not None:
            candidates = only_in(actions[rejected], self.parts.indices[part], candidates)
            allowed = self.allowed_candidates(rows_of(self.raw_last_obs(), rejected), candidates)
        candidate_verdicts = query_candidates(self.predictor, features[rejected], candidates, part)
        permissible = allowed & (candidate_verdicts > 0)  # line 9
        found = permissible.any(axis=1)  # line 10
        self.logger.record_mean("sap/fallback_rate", 1 - found.mean())
        if not found.any():
            return None
        rows = rejected[found]
        scores = self._scores(rows_of(obs, rows), actions[rows], candidates[found], candidate_verdicts[found])
        guided = actions.copy()
        guided[rows] = choose(self.exploration_rng, candidates[found], permissible[found], scores)  # line 11
        return guided  # lines 12-14

    def _scores(self, obs: Any, actions: Any, candidates: Any, logits: FloatArray) -> FloatArray | None:
        """What ``candidate_selection`` maximises, (m, N); None for a random choice."""
        if self.candidate_selection == "random":
            return None
        if self.candidate_selection == "most_permissible":
            return logits
        if self.candidate_selection == "nearest":
            return np.asarray(-np.linalg.norm(candidates - actions[:, None], axis=2))
        m, n, dim = candidates.shape
        repeated = rows_of(obs, np.repeat(np.arange(m), n))
        q = q_values(self, repeated, th.as_tensor(candidates.reshape(m * n, dim), device=self.device))
        return q.cpu().numpy().reshape(m, n)

    # ---------------------------------------------------------------- settings

    @property
    def noise_steps(self) -> int:
        """t_k, or ``learning_starts`` if ``t_k`` is ``None``."""
        return self.learning_starts if self.t_k is None else self.t_k

    @property
    def guidance_ended(self) -> bool:
        """Whether ``guidance_end`` is reached."""
        return self.guidance_end is not None and self.lifetime_steps >= self.guidance_end

    @property
    def current_alpha(self) -> float:
        """α, or at most ``alpha_low`` while E is not accurate enough (section 4.3)."""
        return self._alpha_of(None)

    def _alpha_of(self, part: int | None) -> float:
        accurate = self.predictor_accurate if part is None else bool(self.predictor.trusted[part])
        return self.alpha if accurate else min(self.alpha_low, self.alpha)

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
        if self.candidate_selection not in SELECTIONS:
            raise ValueError(
                f"`candidate_selection` must be one of {', '.join(map(repr, SELECTIONS))}, but is "
                f"{self.candidate_selection!r}."
            )
        if self.noise_steps > self.learning_starts and self.action_noise is None and not self.explores_without_noise:
            warnings.warn(
                f"`t_k` = {self.t_k} is beyond `learning_starts` = {self.learning_starts}, but there is no "
                "`action_noise`: between the two a deterministic policy does not explore.",
                stacklevel=2,
            )
        super()._setup_model()
