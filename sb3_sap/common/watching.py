"""Watches the training environment: raw last observations, steps by other code, and its normalisation."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any, cast

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.common.environment import EnvironmentMixin
from sb3_sap.common.vec_envs import is_at, never_updated, shares_environment, watched_steps


class WatchedEnvironmentMixin(EnvironmentMixin):
    """Gives the buffers each episode's raw last observation, and warns of what would silently corrupt their data."""

    def __init__(self, *args: Any, **kwargs: Any):
        #: Whether observations were normalised in the last training.
        self.learned_normalised = False
        self._warned_of_sharing = False
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        self._check_normalisation()

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._check_normalisation()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        normalize = self._vec_normalize_env
        self.learned_normalised = normalize is not None and normalize.norm_obs
        self._warned_of_sharing = False
        env = cast(VecEnv, self.env)
        if self._last_obs is not None and not is_at(env, normalize, self._last_obs, self._last_original_obs):
            # Other code, such as an evaluation, stepped `env` since: the next transition would begin in another state.
            self._last_obs = None
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        combined = super()._init_callback(callback, progress_bar)
        for each in every_callback(combined):
            if any(shares_environment(cast(VecEnv, self.env), value) for value in vars(each).values()):
                self._warn_of_shared_environment(type(each).__name__)
        return combined

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> Any:
        """SB3's ``collect_rollouts``, with raw last observations and a warning if other code steps the environment."""
        before = self.num_timesteps
        with watched_steps(env, self._vec_normalize_env) as calls:
            rollout = cast(Any, super()).collect_rollouts(env, *args, **kwargs)
        if calls[0] > (self.num_timesteps - before) // self.n_envs:
            self._warn_of_shared_environment("a callback")
        return rollout

    def _warn_of_shared_environment(self, who: str) -> None:
        if not self._warned_of_sharing:
            self._warned_of_sharing = True
            warnings.warn(
                f"The training environment is also used by {who}, and stepping or resetting it there leaves "
                "transitions that never happened in both buffers: evaluate in an environment of its own.",
                stacklevel=2,
            )

    def _check_normalisation(self) -> None:
        """Warns of an environment that does not normalise observations as in the training of a loaded model."""
        if not self.learned_normalised or self.env is None:
            return
        normalize = self._vec_normalize_env
        if normalize is None or not normalize.norm_obs:
            warnings.warn(
                "This model learned from normalised observations, but its environment gives raw ones, with which it "
                "acts at random: wrap it in VecNormalize.load(statistics, env), with the statistics of the training.",
                stacklevel=2,
            )
        elif never_updated(normalize):
            warnings.warn(
                "This model learned from normalised observations, but the statistics of this VecNormalize are those of "
                "no observation at all: load them with VecNormalize.load(statistics, env).",
                stacklevel=2,
            )


def every_callback(callback: BaseCallback) -> Iterator[BaseCallback]:
    """A callback and all callbacks inside it."""
    yield callback
    for name, value in vars(callback).items():
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, BaseCallback) and name != "parent":
                yield from every_callback(child)
