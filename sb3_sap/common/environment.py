"""Checks of the training environment's spaces and wrappers, and its raw observations."""

from __future__ import annotations

from typing import Any, ClassVar

from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.common.spaces import check_action_space, check_observation_space
from sb3_sap.common.vec_envs import (
    channels_last,
    check_wrappers,
    environment_layout,
    policy_layout,
    unnormalized,
)


class EnvironmentMixin(BaseAlgorithm):
    """Checks the environment. Goes before an SB3 algorithm in the bases of a class."""

    #: Whether the algorithm is for discrete actions; inferred for SB3's and sb3-contrib's bases.
    discrete: ClassVar[bool] = False

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any):
        #: Keys of the images that the environment returns channels last, as the user's functions get them.
        self.images: tuple[str, ...] = ()
        if env is not None:
            env = maybe_make_env(env, kwargs.get("verbose", 0))
            self._check_action_space(env.action_space)
            check_observation_space(type(self).__name__, env.observation_space)
            if policy == "MultiInputPolicy" and not isinstance(env.observation_space, spaces.Dict):
                raise ValueError(
                    f"`policy` 'MultiInputPolicy' is for Dict observations, but these are {env.observation_space}: use "
                    "'MlpPolicy', or 'CnnPolicy' for images."
                )
        try:
            super().__init__(policy, env, *args, **kwargs)
        except AssertionError as error:
            if "NatureCNN" not in str(error):
                raise
            raise ValueError(
                f"`policy` {policy!r} is for images (uint8, from 0 to 255), but the observations are "
                f"{env.observation_space}: use 'MlpPolicy', or a `features_extractor_class` of your own."
            ) from error

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        if issubclass(cls, (DQN, QRDQN)):
            cls.discrete = True

    def _check_action_space(self, space: spaces.Space[Any]) -> None:
        """Raises a ``ValueError`` for an action space that the algorithm cannot use."""
        check_action_space(type(self).__name__, space, self.discrete)

    def _setup_model(self) -> None:
        self._inspect(self.env)
        super()._setup_model()  # type: ignore[safe-super]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._inspect(self.env)

    def _inspect(self, env: VecEnv | None) -> None:
        """Checks the wrappers, and reads from them in which layout the environment returns images."""
        if env is not None:
            check_wrappers(env)
            self.images = channels_last(env)

    def raw_last_obs(self) -> Any:
        """The environments' last observations, (n_envs, *obs_shape), as the user's functions get them: not normalised,
        and images in the environment's own layout.
        """
        raw = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        return environment_layout(raw, self.images)

    def raw_observations(self, observation: Any) -> Any:
        """(n, *obs_shape) observations as the user's functions get them, of one or a batch as ``predict`` takes it."""
        if observation is self._last_obs:
            return self.raw_last_obs()  # exact, whereas rounded and clipped ones cannot be recovered
        raw = policy_layout(observation, self.observation_space)
        if not self.policy.is_vectorized_observation(observation):
            raw = {key: value[None] for key, value in raw.items()} if isinstance(raw, dict) else raw[None]
        env = self.get_vec_normalize_env()
        return environment_layout(raw if env is None else unnormalized(env, raw, self.observation_space), self.images)
