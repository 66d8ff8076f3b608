"""Hand-made constraints on exploration, the baselines of section 5.1."""

from __future__ import annotations

from typing import Any, Protocol, cast

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_sap.generators import make_rng
from sb3_sap.permissibility import FloatArray, resolve
from sb3_sap.settings import SettingsMixin


class ActionConstraint(Protocol):
    """The interval of actions that a rule allows in one environment.

    :param obs: raw observation now
    :param previous_obs: raw observation one step before, in the same episode
    :param last_action: the action executed there, in the environment's units
    :return: (low, high), each (action_dim,), in the environment's units
    """

    def __call__(self, obs: Any, previous_obs: Any, last_action: Any, /) -> tuple[Any, Any]: ...


class ConstrainedExplorationMixin(SettingsMixin):
    """Replaces actions outside an interval by uniform draws from it (section 5.1, DDPG-CE1 and -CE2).

    :param constraint: an :class:`ActionConstraint`, or its dotted name; asked from the second step of an episode on
    """

    def __init__(self, *args: Any, constraint: ActionConstraint | str | None = None, **kwargs: Any):
        self.constraint = constraint
        self._rng = cast(np.random.Generator, None)  # made in set_random_seed, kept by save and load
        self._previous: list[tuple[Any, Any] | None] = []  # (raw obs, executed action) of each environment
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        saved_rng = self._rng
        self._constraint = None if self.constraint is None else resolve(self.constraint, "constraint")
        super()._setup_model()
        # Without a seed SB3 leaves its generators alone; `load` has restored ours already.
        self._rng = saved_rng or self._rng or make_rng(None, "exploration")

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None:
            self._rng = make_rng(seed, "exploration")

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
        if self._constraint is None:
            return action, scaled
        low, high = self._allowed_interval(n_envs)
        outside = ((scaled < low) | (scaled > high)).reshape(n_envs, -1).any(axis=1)
        if outside.any():
            scaled[outside] = self._rng.uniform(low[outside], high[outside])
            action = self.policy.unscale_action(scaled)
        return action, scaled

    def _allowed_interval(self, n_envs: int) -> tuple[FloatArray, FloatArray]:
        """The scaled actions that the constraint allows now: low and high, each (n_envs, *action_shape)."""
        high = np.ones((n_envs, *cast(Any, self.action_space).shape), dtype=np.float32)
        low = -high
        if self._constraint is not None:
            for i, previous in enumerate(self._previous):
                if previous is not None:
                    interval = self._constraint(_row(self._raw_last_obs(), i), *previous)
                    # An interval may reach beyond the action space; what counts is the part inside.
                    low[i], high[i] = (np.clip(self.policy.scale_action(np.asarray(b)), -1, 1) for b in interval)
                    if not (low[i] <= high[i]).all():
                        raise ValueError(f"`constraint` must return (low, high) with low <= high, but gave {interval}.")
        return low, high

    def _raw_last_obs(self) -> Any:
        return self._last_obs if self._vec_normalize_env is None else self._last_original_obs

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
            obs, executed = self._raw_last_obs(), self.policy.unscale_action(buffer_action)
            self._previous = [None if done else (_row(obs, i), executed[i]) for i, done in enumerate(dones)]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_constraint", "_previous"]


def _row(obs: Any, i: int) -> Any:
    """The observation of environment i."""
    return {key: value[i] for key, value in obs.items()} if isinstance(obs, dict) else obs[i]
