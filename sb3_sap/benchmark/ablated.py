"""Ablated variants of DDPG-AP and of its observation, used only by the benchmark."""

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
    """Rescales the lane-keeping observation to other units, because the paper names none.

    :param observation_space: of lane keeping, shape (5,)
    """

    units: tuple[float, float, float, float, float]
    """Factors of angle, trackPos, speedX, speedY and speedZ."""
    scale: th.Tensor

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space)
        self.register_buffer("scale", th.tensor(self.units))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations * self.scale)


class KilometresPerHour(OtherUnits):
    """Speeds in km/h, as Table 1 lists them: values near 50 beside an angle of hundredths."""

    units = (1.0, 1.0, 50.0, 50.0, 50.0)


class TorcsKeras(OtherUnits):
    """Angles in π rad and speeds in 300 km/h, as in the code that the paper cites in its footnote 2."""

    units = (1 / math.pi, 1.0, 1 / 6, 1 / 6, 1 / 6)


class UnbalancedFit(PermissibilityCallback):
    """Fits E on an unbalanced D_E; the validation set remains balanced, so that accuracies can be compared."""

    def fit(self) -> None:
        """Makes one pass over an unbalanced D_E."""
        model = self.model
        sample = self.knowledge.sample(model.dataset_size, env=model.get_vec_normalize_env(), balanced=False)
        self.logger.record_mean("sap/predictor_loss", model.predictor.fit(sample))


class DDPGAPUnbalanced(DDPGAP):
    """DDPG-AP whose E learns from the labels in the proportion in which they occur."""

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        if not isinstance(callback, (list, BaseCallback)):
            callback = ConvertCallback(callback)
        return super()._init_callback(
            [UnbalancedFit(), *(callback if isinstance(callback, list) else [callback])], progress_bar
        )


class DDPGAPProposed(DDPGAP):
    """DDPG-AP whose R stores the action that the actor proposed; K still stores the action that was executed."""

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
        # R is changed after it has passed the transition on to K, which labels the executed action.
        replay_buffer.actions[replay_buffer.pos - 1] = cast("np.ndarray[Any, Any]", self._proposed)
