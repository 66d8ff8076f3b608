"""Gymnasium's Taxi with an observation that networks can read, and the mask of the actions that have an effect."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.toy_text.taxi import TaxiEnv

#: Row, column, where the passenger is (four stands, or 4: in the taxi), destination.
SIZES = [5, 5, 5, 4]


class DecodedTaxi(gym.ObservationWrapper[Any, Any, Any]):
    """Taxi, which numbers its 500 states, with the four numbers that make up a state.

    :param render_mode: of Taxi
    """

    def __init__(self, render_mode: str | None = None):
        super().__init__(TaxiEnv(render_mode=render_mode))
        self.observation_space = spaces.MultiDiscrete(SIZES)

    def observation(self, observation: Any) -> np.ndarray[Any, Any]:
        return np.array(np.unravel_index(int(observation), tuple(SIZES)))

    def action_masks(self) -> np.ndarray[Any, Any]:
        """(6,) bool, which actions change the state: no wall is in the way, somebody is there to pick up or drop."""
        taxi: Any = self.env
        return np.asarray(taxi.action_mask(taxi.s), dtype=bool)
