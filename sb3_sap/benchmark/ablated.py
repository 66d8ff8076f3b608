"""Parts taken out or turned round, for what the benchmark asks alone."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_sap.algorithms import DDPGAP
from sb3_sap.predictor.callbacks import PermissibilityCallback


class OtherUnits(FlattenExtractor):
    """Lane keeping's observation in other units, of which the paper names none."""

    units: tuple[float, float, float, float, float]
    """What angle, trackPos and the three speeds are multiplied by."""
    scale: th.Tensor

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space)
        self.register_buffer("scale", th.tensor(self.units))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations * self.scale)


class KilometresPerHour(OtherUnits):
    """As Table 1 lists them: speeds of 50 beside an angle of hundredths."""

    units = (1.0, 1.0, 50.0, 50.0, 50.0)


class TorcsKeras(OtherUnits):
    """As in the code that the paper cites in its footnote 2: angles in π rad, speeds in 300 km/h."""

    units = (1 / math.pi, 1.0, 1 / 6, 1 / 6, 1 / 6)


class UnbalancedFit(PermissibilityCallback):
    """Draws D_E as K is, not balanced; validation stays balanced, so that accuracies compare."""

    def fit(self) -> None:
        """One pass over an unbalanced D_E."""
        model = self.model
        sample = self.knowledge.sample(model.dataset_size, env=model.get_vec_normalize_env(), balanced=False)
        self.logger.record_mean("sap/predictor_loss", model.predictor.fit(sample))


class DDPGAPUnbalanced(DDPGAP):
    """E learns from the labels in the proportion in which they occur."""

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        if not isinstance(callback, (list, BaseCallback)):
            callback = ConvertCallback(callback)
        return super()._init_callback(
            [UnbalancedFit(), *(callback if isinstance(callback, list) else [callback])], progress_bar
        )


class DDPGAPProposed(DDPGAP):
    """The replay buffer R stores the action that the actor proposed, not the one executed; K stores the latter."""

    def _sample_action(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        self._proposed: np.ndarray[Any, Any] | None = None
        action, scaled = super()._sample_action(*args, **kwargs)
        self._proposed = scaled if self._proposed is None else self._proposed
        return action, scaled

    def guide(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
        self._proposed = actions.copy()
        return super().guide(actions)

    def _store_transition(self, replay_buffer: ReplayBuffer, *args: Any, **kwargs: Any) -> None:
        super()._store_transition(replay_buffer, *args, **kwargs)
        # Only now, because K has labelled what was executed.
        replay_buffer.actions[replay_buffer.pos - 1] = cast("np.ndarray[Any, Any]", self._proposed)
