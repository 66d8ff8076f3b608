"""Exploration within constraints and permissible actions, both known before an action is executed."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_sap.common.arrays import BoolArray, FloatArray, rows_of
from sb3_sap.common.errors import check_at_least
from sb3_sap.common.functions import resolve
from sb3_sap.common.random import make_rng
from sb3_sap.guidance.candidates import candidate_actions, choose
from sb3_sap.guidance.constraints import ActionConstraint, query_constraint
from sb3_sap.guidance.masked_values import MaskedValuesMixin
from sb3_sap.guidance.masks import PermissibleActions, mask_source
from sb3_sap.permissibility import query_labels


class ConstrainedExplorationMixin(MaskedValuesMixin):
    """While training, replaces forbidden actions by uniform draws from the allowed ones.

    :param constraint: an :class:`~sb3_sap.guidance.constraints.ActionConstraint` or its dotted name, applied from the
        second step of each episode (section 5.1, DDPG-CE1 and -CE2)
    :param permissible_actions: a :class:`~sb3_sap.guidance.masks.PermissibleActions` or its dotted name, or the key of
        a mask in a ``Dict`` observation (:class:`~sb3_sap.guidance.mask_wrapper.ActionMaskObservation`), applied at
        every step. Where it allows none of the candidates, the action is left as it is. For discrete actions the
        greedy choice, ``predict`` and the target's maximum are over the allowed actions, too
    :param n_candidates: N of Algorithm 1, line 8, the size of A_st; for discrete actions A_st is every action
    """

    def __init__(
        self,
        *args: Any,
        constraint: ActionConstraint | str | None = None,
        permissible_actions: PermissibleActions | str | None = None,
        n_candidates: int = 128,
        **kwargs: Any,
    ):
        self.constraint = constraint
        self.permissible_actions = permissible_actions
        self.n_candidates = n_candidates
        #: Generator of candidates and choices; made in `set_random_seed`, kept by save and load.
        self.exploration_rng = cast(np.random.Generator, None)
        self._previous: list[tuple[Any, Any] | None] = []  # (raw obs, executed action) of each environment
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        saved_rng = self.exploration_rng
        check_at_least(self, n_candidates=1)
        self._constraint = None if self.constraint is None else resolve(self.constraint, "constraint")
        self._permissible_actions = mask_source(self.permissible_actions, self.observation_space, self.action_space)
        if self._constraint is not None and isinstance(self.action_space, spaces.Discrete):
            raise ValueError(
                "`constraint` is an interval of continuous actions, but this action space is "
                f"{self.action_space}: say what is allowed with `permissible_actions`."
            )
        super()._setup_model()
        # Without a seed SB3 does not seed anything; `load` has already restored the saved generator.
        self.exploration_rng = saved_rng or self.exploration_rng or make_rng(None, "exploration")

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None:
            self.exploration_rng = make_rng(seed, "exploration")

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None:
            self._previous = [None] * self.n_envs  # the environments will be reset
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        action, scaled = super()._sample_action(learning_starts, action_noise, n_envs)
        if scaled.shape != (n_envs, *cast(Any, self.action_space).shape):
            raise ValueError(
                f"`action_noise` turned {n_envs} actions of {self.action_space} into an array of shape {scaled.shape}: "
                "give a noise whose mean and sigma have the shape of one action."
            )
        if self._constraint is not None:
            low, high = self._allowed_interval(n_envs)
            outside = ((scaled < low) | (scaled > high)).reshape(n_envs, -1).any(axis=1)
            if outside.any():
                scaled[outside] = self.exploration_rng.uniform(low[outside], high[outside])
                action = self.unscale_actions(scaled)
        if self._permissible_actions is not None:
            forbidden = np.flatnonzero(~self._allowed(self.raw_last_obs(), scaled))
            if len(forbidden):
                candidates, allowed = self.sample_candidates(forbidden, n_envs)
                found = allowed.any(axis=1)
                if found.any():
                    chosen = choose(self.exploration_rng, candidates[found], allowed[found], scores=None)
                    scaled[forbidden[found]] = chosen.reshape(-1, *scaled.shape[1:])
                    action = self.unscale_actions(scaled)
        return action, scaled

    def sample_candidates(self, rows: np.ndarray[Any, Any], n_envs: int) -> tuple[np.ndarray[Any, Any], BoolArray]:
        """A_st of the environments in ``rows``, (m, N, action_dim) scaled, and which are allowed, (m, N)."""
        low, high = (bound.reshape(n_envs, -1)[rows] for bound in self._allowed_interval(n_envs))
        candidates = candidate_actions(self.exploration_rng, self.action_space, low, high, self.n_candidates)
        return candidates, self.allowed_candidates(rows_of(self.raw_last_obs(), rows), candidates)

    def allowed_candidates(self, raw_obs: Any, candidates: np.ndarray[Any, Any]) -> BoolArray:
        """Which of (m, N, action_dim) candidates ``permissible_actions`` allows in m states, (m, N)."""
        m, n, _ = candidates.shape
        if self._permissible_actions is None:
            return np.ones((m, n), dtype=bool)
        repeated = rows_of(raw_obs, np.repeat(np.arange(m), n))
        return self._allowed(repeated, candidates.reshape(m * n, *cast(Any, self.action_space).shape)).reshape(m, n)

    def _allowed(self, raw_obs: Any, scaled: np.ndarray[Any, Any]) -> BoolArray:
        assert self._permissible_actions is not None
        return query_labels(self._permissible_actions, "permissible_actions", raw_obs, self.unscale_actions(scaled))

    def unscale_actions(self, scaled: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Scaled actions in the environment's units; discrete actions are returned unchanged."""
        return scaled if isinstance(self.action_space, spaces.Discrete) else self.policy.unscale_action(scaled)

    def _allowed_interval(self, n_envs: int) -> tuple[FloatArray, FloatArray]:
        """The scaled actions that the constraint allows now: low and high, each (n_envs, *action_shape)."""
        high = np.ones((n_envs, *cast(Any, self.action_space).shape), dtype=np.float32)
        low = -high
        if self._constraint is not None:
            for i, previous in enumerate(self._previous):
                if previous is not None:
                    interval = query_constraint(
                        self._constraint, low[i].shape, rows_of(self.raw_last_obs(), i), *previous
                    )
                    # An interval may extend beyond the action space; only the part inside counts.
                    low[i], high[i] = (np.clip(self.policy.scale_action(bound), -1, 1) for bound in interval)
                    if not (low[i] <= high[i]).all():
                        raise ValueError(f"`constraint` must return (low, high) with low <= high, but gave {interval}.")
        return low, high

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray[Any, Any],
        new_obs: Any,
        reward: np.ndarray[Any, Any],
        dones: np.ndarray[Any, Any],
        infos: list[dict[str, Any]],
    ) -> None:
        if self._constraint is not None:
            obs, executed = self.raw_last_obs(), self.policy.unscale_action(buffer_action)
            self._previous = [None if done else (rows_of(obs, i), executed[i]) for i, done in enumerate(dones)]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_constraint", "_permissible_actions", "_previous"]
