"""MiniGrid with an observation that networks can read, and labels from the environment itself."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

#: Directions that the agent can face.
DIRECTIONS = 4


class LabelledGrid(gym.Wrapper[Any, Any, Any, Any]):
    """A task of MiniGrid that calls an action without effect a mistake, in ``info["permissible"]``.

    *Argument.* The agent walked into a wall, or there was nothing to pick up, drop or open. The reward falls with the
    steps taken, and is discounted besides, so that the same state a step later is worth less than now: the label is
    sound. A step that ends the episode is not judged, because in some tasks the action without effect says "done".

    The observation is the view of 7 by 7 cells ahead, one-hot, and the direction, one-hot. The mission, a sentence, is
    left out: tasks in which it changes cannot be learned from it.

    :param env: a task of MiniGrid, such as ``gym.make("MiniGrid-DoorKey-5x5-v0")``
    :raise ModuleNotFoundError: if minigrid is not installed
    """

    def __init__(self, env: gym.Env[Any, Any]):
        from minigrid import wrappers

        one_hot = cast(Any, wrappers).OneHotPartialObsWrapper(env)
        super().__init__(one_hot)
        image = one_hot.observation_space["image"]
        self.observation_space = spaces.Box(0, 1, (int(np.prod(image.shape)) + DIRECTIONS,), np.uint8)
        self._state: bytes = b""

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        self._state = self._described()
        return self._flat(obs), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(int(action))
        before, self._state = self._state, self._described()
        info = {**info, "permissible": bool(terminated or self._state != before), "is_success": float(reward) > 0}
        return self._flat(obs), reward, terminated, truncated, info

    def _flat(self, obs: dict[str, Any]) -> np.ndarray[Any, Any]:
        facing = np.arange(DIRECTIONS) == obs["direction"]
        return np.concatenate([obs["image"].ravel(), facing]).astype(np.uint8)

    def _described(self) -> bytes:
        """All that an action can change: the grid, the agent's place and direction, and what it carries."""
        grid: Any = self.unwrapped
        carried = None if grid.carrying is None else grid.carrying.encode()
        agent = (*map(int, grid.agent_pos), int(grid.agent_dir), carried)
        return bytes(grid.grid.encode().tobytes()) + repr(agent).encode()
