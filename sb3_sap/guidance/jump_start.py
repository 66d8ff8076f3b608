"""Acting by a guide while the agent knows nothing, and handing over as it improves (not in the paper)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise

from sb3_sap.common.acting import Actor
from sb3_sap.common.arrays import copy_observation
from sb3_sap.common.errors import check_at_least
from sb3_sap.common.functions import resolve
from sb3_sap.common.settings import SettingsMixin
from sb3_sap.guidance.values import q_values


class Predicts(Protocol):
    """Anything that acts as SB3's policies do."""

    def predict(self, observation: Any, /, *, deterministic: bool) -> Any: ...


class JumpStartMixin(SettingsMixin):
    """Lets a guide act at first, in place of uniform random actions.

    The agent begins where the guide leads it, instead of where chance does (Uchendu et al. 2023). After ``guide_steps``
    the guide's action and the agent's compete in each state, and that of the higher value is executed, as in
    imitation-bootstrapped learning (Hu et al. 2023): the guide hands over where the agent has become better, and
    nowhere else. For discrete actions, whose greedy choice has the highest value by definition, the guide's action
    takes the place of the random ones of ε-greedy exploration.

    :param guide_policy: a controller, an old policy: a function of (n, *obs_shape) raw observations that returns
        (n, *action_shape) actions in the environment's units, its dotted name, or an object with ``predict`` such as a
        model of SB3. ``None``: nobody
    :param guide_steps: timesteps during which the guide alone acts. ``None``: ``learning_starts``
    :param guide_end: timestep after which the guide is not asked any more; ``None``: never
    """

    def __init__(
        self,
        *args: Any,
        guide_policy: Callable[[Any], Any] | Predicts | str | None = None,
        guide_steps: int | None = None,
        guide_end: int | None = None,
        **kwargs: Any,
    ):
        self.guide_policy = guide_policy
        self.guide_steps = guide_steps
        self.guide_end = guide_end
        self._guide: Actor | None = None
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        for name in ("guide_steps", "guide_end"):
            if getattr(self, name) is not None:
                check_at_least(self, **{name: 0})
        super()._setup_model()

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        action, scaled = super()._sample_action(learning_starts, action_noise, n_envs)
        steps: int = getattr(self, "lifetime_steps", self.num_timesteps)
        if self.guide_policy is None or (self.guide_end is not None and steps >= self.guide_end):
            return action, scaled
        own, guides = scaled, self._actions_of_guide(n_envs)
        alone = steps < (self.learning_starts if self.guide_steps is None else self.guide_steps)
        chosen = np.ones(n_envs, dtype=bool) if alone else self._prefers(guides, own)
        self.logger.record_mean("sap/guide_rate", chosen.mean())
        scaled = np.where(chosen.reshape(-1, *(1,) * (own.ndim - 1)), guides, own).astype(own.dtype)
        return self._in_units(scaled), scaled

    def _store_transition(
        self, replay_buffer: ReplayBuffer, buffer_action: Any, new_obs: Any, reward: Any, dones: Any, infos: Any
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = dones  # SB3 keeps it for on-policy algorithms alone

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_guide"]

    def _actions_of_guide(self, n_envs: int) -> np.ndarray[Any, Any]:
        """(n_envs, *action_shape) scaled actions of the guide.

        :raise ValueError: if they are not of the action space
        """
        space, obs = cast(Any, self.action_space), copy_observation(self.raw_last_obs())
        guide: Any = self.guide_policy
        if hasattr(guide, "predict"):
            if self._guide is None or self._guide.policy is not guide:
                self._guide = Actor(guide)
            given = self._guide(obs, self._last_episode_starts)
        else:
            given = resolve(guide, "guide_policy")(obs)
        actions = np.asarray(given)
        if actions.shape != (n_envs, *space.shape) or not np.isfinite(actions).all():
            raise ValueError(
                f"`guide_policy` must return finite actions of shape {(n_envs, *space.shape)}, one for each "
                f"environment, but returned an array of shape {actions.shape}."
            )
        if not isinstance(space, spaces.Box):
            if (
                not all(space.contains(one) for one in actions.astype(space.dtype))
                or (actions != np.rint(actions)).any()
            ):
                raise ValueError(f"`guide_policy` returned actions outside of {space}: {actions}.")
            return actions.astype(space.dtype)
        # A controller that asks for more than is possible gets what is possible.
        clipped = np.clip(actions, space.low, space.high)
        return np.asarray(self.policy.scale_action(clipped), dtype=np.float32)

    @th.no_grad()
    def _prefers(self, guides: np.ndarray[Any, Any], own: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """(n_envs,) where the guide's action is executed."""
        obs, _ = self.policy.obs_to_tensor(cast(Any, self._last_obs))
        if isinstance(self.action_space, spaces.Discrete):
            greedy = np.asarray(self.predict(cast(Any, self._last_obs), deterministic=True)[0])  # within the masks
            return np.asarray(own != greedy.reshape(own.shape))
        values = [
            q_values(self, obs, th.as_tensor(actions.reshape(len(actions), -1), device=self.device)).cpu().numpy()
            for actions in (guides, own)
        ]
        return np.asarray(values[0] > values[1])

    def _in_units(self, scaled: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return scaled if isinstance(self.action_space, spaces.Discrete) else self.policy.unscale_action(scaled)
