"""Masks of known permissible actions in DQN and QR-DQN: in the greedy choice and in the target's maximum."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sap.common.arrays import BoolArray
from sb3_sap.common.vec_envs import environment_layout
from sb3_sap.guidance.jump_start import JumpStartMixin
from sb3_sap.guidance.masks import PermissibleActions, masks_at, masks_of


class MaskedValuesMixin(JumpStartMixin):
    """Chooses the best of the actions that ``permissible_actions`` allows, in acting and in the target of the update.

    For algorithms of discrete actions; others are left as they are. Where nothing is allowed, everything is.
    """

    _permissible_actions: PermissibleActions | None
    exploration_rng: np.random.Generator

    @property
    def _masks_values(self) -> bool:
        return self.discrete and self._permissible_actions is not None

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray[Any, Any], ...] | None = None,
        episode_start: np.ndarray[Any, Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray[Any, Any], tuple[np.ndarray[Any, Any], ...] | None]:
        if not self._masks_values:
            return super().predict(observation, state, episode_start, deterministic)
        mask = masks_at(self, cast(PermissibleActions, self._permissible_actions), observation)
        with masked_outputs(values_network(self), lambda: mask):
            actions, state = super().predict(observation, state, episode_start, deterministic)
        # What the ε-greedy exploration draws is drawn anew from the allowed actions.
        flat = np.array(actions).reshape(-1)
        for row in np.flatnonzero(~mask[np.arange(len(flat)), flat]):
            flat[row] = self.exploration_rng.choice(np.flatnonzero(mask[row]))
        return flat.reshape(np.shape(actions)), state

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """SB3's ``train``, in which the target's maximum is over the allowed actions of each next state."""
        if not self._masks_values:
            super().train(gradient_steps, batch_size)
            return
        with (
            raw_next_observations(self.replay_buffer) as batch,
            masked_outputs(values_network(self, target=True), lambda: self._next_mask(batch[0])),
        ):
            super().train(gradient_steps, batch_size)

    def _next_mask(self, obs: Any) -> BoolArray:
        space: Any = self.observation_space
        if isinstance(obs, dict):
            raw: Any = {key: _array(value, space[key]) for key, value in obs.items()}
        else:
            raw = _array(obs, space)
        source = cast(PermissibleActions, self._permissible_actions)
        return masks_of(source, self.action_space, environment_layout(raw, self.images))


def values_network(model: Any, target: bool = False) -> nn.Module:
    """The Q-network of DQN or the quantile network of QR-DQN, or the target network."""
    name = "quantile_net" if hasattr(model.policy, "quantile_net") else "q_net"
    return cast(nn.Module, getattr(model.policy, f"{name}_target" if target else name))


@contextmanager
def masked_outputs(network: nn.Module, mask: Callable[[], BoolArray]) -> Iterator[None]:
    """Within the block, the values of actions that are not allowed are minus infinity.

    :param network: of (n, k) values or (n, quantiles, k) quantiles of k actions
    :param mask: (n, k) bool, for the observations of the pass in progress
    """

    def hide(module: nn.Module, args: Any, values: th.Tensor) -> th.Tensor:
        allowed = th.as_tensor(mask(), device=values.device)
        return values.masked_fill(~(allowed if values.ndim == 2 else allowed[:, None]), -th.inf)

    handle = network.register_forward_hook(hide)
    try:
        yield
    finally:
        handle.remove()


@contextmanager
def raw_next_observations(buffer: Any) -> Iterator[list[Any]]:
    """Within the block, keeps the next observations of each batch that is sampled as they were before VecNormalize.

    They cannot be recovered from normalised ones, which are rounded and clipped.

    :param buffer: a replay buffer of SB3's
    :return: a list whose only entry is the last batch's
    """
    kept: list[Any] = [None]
    sample, normalize = buffer.sample, buffer._normalize_obs

    def raw_sample(batch_size: int, env: VecNormalize | None = None) -> Any:
        buffer._normalize_obs = lambda obs, env=None: obs
        try:
            data = sample(batch_size, env)
        finally:
            del buffer._normalize_obs
        kept[0] = data.next_observations
        if env is None:
            return data
        sides = ("observations", "next_observations")
        return data._replace(**{side: _normalized(buffer, normalize, getattr(data, side), env) for side in sides})

    buffer.sample = raw_sample
    try:
        yield kept
    finally:
        del buffer.sample


def _normalized(buffer: Any, normalize: Callable[..., Any], obs: Any, env: VecNormalize) -> Any:
    if isinstance(obs, dict):
        arrays = normalize({key: value.cpu().numpy() for key, value in obs.items()}, env)
        return {key: buffer.to_torch(value) for key, value in arrays.items()}
    return buffer.to_torch(normalize(obs.cpu().numpy(), env))


def _array(values: th.Tensor, space: spaces.Space[Any]) -> np.ndarray[Any, Any]:
    """(n, *shape): replay buffers hold numbers of a ``Discrete`` space as (n, 1)."""
    return values.cpu().numpy().reshape(len(values), *(space.shape or ()))
