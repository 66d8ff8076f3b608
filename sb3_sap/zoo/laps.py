"""An environment whose episodes are laps of several tracks in turn, on which a study evaluates."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import gymnasium as gym

from sb3_sap.envs import score

#: Registered here, so that rl_zoo3 and SB3 evaluate on it as on any other environment.
ENV_ID = "sap/ValidationLaps-v0"


class Laps(gym.Env[Any, Any]):
    """One lap of each track in turn, in units of the normalised score: the rewards of an episode add up to S.

    :param env_id: a lane-keeping environment
    :param tracks: driven in this order, the first one first
    :param kwargs: further arguments of that environment
    """

    def __init__(self, env_id: str, tracks: list[str], **kwargs: Any):
        self.tracks = tracks
        self._envs = [gym.make(env_id, track=track, **{**kwargs, "laps": 1}) for track in tracks]
        self._turn = cycle(self._envs)
        self._env = self._envs[0]
        self.observation_space = self._env.observation_space
        self.action_space = self._env.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._env = next(self._turn)
        simulator = self._env.unwrapped.simulator  # type: ignore[attr-defined]
        self._unit = score(1.0, simulator.length, simulator.control_step)
        return self._env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self._env.step(action)
        return obs, float(reward) * self._unit, terminated, truncated, info

    def close(self) -> None:
        for env in self._envs:
            env.close()


gym.register(ENV_ID, f"{__name__}:{Laps.__name__}")
