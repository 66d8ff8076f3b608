"""Puts an environment's action masks into its observations, where replay buffers and policies find them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_sap.common.spaces import sizes_of


class ActionMaskObservation(gym.Wrapper[Any, Any, Any, Any]):
    """Adds the mask of each state to its observation, from ``env.action_masks()`` or else ``info["action_mask"]``.

    Put it inside of each environment that is vectorised, and give the model ``permissible_actions="action_mask"``. The
    mask then belongs to the state, in an episode's last one as well, whereas after the automatic reset of a vectorised
    environment ``action_masks()`` speaks of the next episode. Observations become a ``Dict``, for
    ``"MultiInputPolicy"``; one that is none gets the key ``"observation"``. The networks see the mask, too, unless the
    policy has :class:`~sb3_sap.common.extractors.WithoutMaskExtractor`.

    :param env: with a ``Discrete``, ``MultiDiscrete`` or ``MultiBinary`` action space
    :param key: of the mask in the observation
    :param joint: for several dimensions: whether a mask has one value for each combination of choices, of the shape
        (n_1, n_2, …), instead of one for each choice, one dimension after the other
    :raise ValueError: if the actions are not finitely many, if the key exists, or if a mask is missing or does not fit
    """

    def __init__(self, env: gym.Env[Any, Any], key: str = "action_mask", joint: bool = False):
        super().__init__(env)
        if isinstance(env.action_space, spaces.Box):
            raise ValueError(f"A mask lists finitely many actions, but the action space is {env.action_space}.")
        own = env.observation_space
        entries = dict(own.spaces) if isinstance(own, spaces.Dict) else {"observation": own}
        if key in entries:
            raise ValueError(
                f"The observation has an entry {key!r} already: give the model `permissible_actions={key!r}` if that "
                "is the mask, or choose another `key`."
            )
        sizes = sizes_of(env.action_space)
        self.key = key
        self._shape = tuple(sizes) if joint else (sum(sizes),)
        self._is_dict = isinstance(own, spaces.Dict)
        self.observation_space = spaces.Dict({**entries, key: spaces.MultiBinary(self._shape)})

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        return self._with_mask(obs, info), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._with_mask(obs, info), reward, terminated, truncated, info

    def _with_mask(self, obs: Any, info: dict[str, Any]) -> dict[str, Any]:
        if self.env.has_wrapper_attr("action_masks"):
            mask = self.env.get_wrapper_attr("action_masks")()
        elif "action_mask" in info:
            mask = info["action_mask"]
        else:
            raise ValueError(
                f"{self.env} has no method `action_masks()` and puts no 'action_mask' into `info`: add either, also "
                "for the state after `reset`."
            )
        mask = np.asarray(mask)
        if mask.dtype.kind not in "biu" or not np.isin(mask, (0, 1)).all():
            raise ValueError(f"An action mask must hold True or False, but is {mask!r}.")
        if mask.shape != self._shape:
            raise ValueError(
                f"An action mask of {self.env.action_space} must have the shape {self._shape}, but has {mask.shape}: "
                "see `joint` of ActionMaskObservation."
            )
        # A copy, because an environment may go on with its array.
        return {**(obs if self._is_dict else {"observation": obs}), self.key: mask.astype(np.int8)}
