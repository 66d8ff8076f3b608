"""Features extractors: how networks read an observation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor

from sb3_sap.common.errors import is_number
from sb3_sap.common.functions import resolve


class RescaleExtractor(FlattenExtractor):
    """Flattens the observation and scales each bounded entry to [-1, 1]; by default E uses it as the policy does.

    SB3 does not scale bounded observations. If the range of one entry is a small fraction of another's, as that of
    MountainCar's velocity, networks hardly distinguish its values, and the actor saturates before it learns to.
    The AP function and the user's other functions still get the observation itself.

    ``policy_kwargs={"features_extractor_class": RescaleExtractor}``, in YAML ``sb3_sap.RescaleExtractor``.

    :param observation_space: a Box; its unbounded entries stay as they are
    """

    scale: th.Tensor
    shift: th.Tensor

    def __init__(self, observation_space: spaces.Box):
        if not isinstance(observation_space, spaces.Box) or is_image_space(observation_space):
            raise ValueError(
                f"RescaleExtractor is for arrays of numbers, but the observation space is {observation_space}: leave "
                "`features_extractor_class` out, or wrap the environment."
            )
        super().__init__(observation_space)
        # Bounds of ±3e38 stand for no bounds: in single precision their difference is infinite.
        with np.errstate(over="ignore", invalid="ignore"):
            low, high = (bound.astype(np.float32) for bound in (observation_space.low, observation_space.high))
            half, middle = (high - low) / 2, (high + low) / 2
        bounded = np.isfinite(half) & (half > 0)
        self.register_buffer("scale", th.as_tensor(np.where(bounded, half, 1.0), dtype=th.float32))
        self.register_buffer("shift", th.as_tensor(np.where(bounded, middle, 0.0), dtype=th.float32))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward((observations - self.shift) / self.scale)


class GoalGapExtractor(BaseFeaturesExtractor):
    """Reads an observation with a goal as the gap from what is achieved to what is desired.

    Positions in metres of which a few centimetres matter are read badly, and their small difference worse.

    :param observation_space: a ``Dict`` with "achieved_goal", "desired_goal" and "observation", arrays of numbers
    :param unit: of the gap, for example the distance that counts as success
    :param entries: which entries of "observation" are kept beside the gap, in the same unit, such as velocities;
        ``None``: none
    """

    def __init__(self, observation_space: spaces.Dict, unit: float = 1.0, entries: Sequence[int] | None = None):
        keys = ("observation", "achieved_goal", "desired_goal")
        if not isinstance(observation_space, spaces.Dict) or not set(keys) <= set(observation_space.spaces):
            raise ValueError(
                f"GoalGapExtractor needs a Dict observation with {', '.join(keys)}, but the observation space is "
                f"{observation_space}: leave `features_extractor_class` out."
            )
        if not (is_number(unit) and unit > 0):
            raise ValueError(f"`unit` of GoalGapExtractor must be a number above 0, but is {unit!r}.")
        self.entries = list(entries or [])
        super().__init__(
            observation_space, get_flattened_obs_dim(observation_space["achieved_goal"]) + len(self.entries)
        )
        self.unit = unit

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        gap = observations["desired_goal"] - observations["achieved_goal"]
        return th.cat([gap, observations["observation"][:, self.entries]], dim=1) / self.unit


class WithoutMaskExtractor(CombinedExtractor):
    """SB3's extractor of ``Dict`` observations, which leaves the action mask out.

    What a mask forbids is known before a network is asked, and a mask of a thousand actions is a thousand inputs.

    :param observation_space: a ``Dict`` with that entry and others
    :param key: of the mask, as in :class:`~sb3_sap.guidance.mask_wrapper.ActionMaskObservation`
    :param kwargs: of SB3's ``CombinedExtractor``
    """

    def __init__(self, observation_space: spaces.Dict, key: str = "action_mask", **kwargs: Any):
        entries = dict(observation_space.spaces)
        if entries.pop(key, None) is None or not entries:
            raise ValueError(
                f"WithoutMaskExtractor leaves out {key!r}, but the observation space is {observation_space}: wrap the "
                "environment in `ActionMaskObservation`, or name the mask in `features_extractor_kwargs`."
            )
        super().__init__(spaces.Dict(entries), **kwargs)


def with_extractor(policy_kwargs: Any) -> dict[str, Any]:
    """A copy of ``policy_kwargs`` in which the dotted name of a features extractor is replaced by the class."""
    if policy_kwargs is not None and not isinstance(policy_kwargs, Mapping):
        raise TypeError(f"`policy_kwargs` and `predictor_kwargs` must be dictionaries, but one is {policy_kwargs!r}.")
    arguments = dict(policy_kwargs or {})
    name = "features_extractor_class"
    if name in arguments:
        arguments[name] = resolve(arguments[name], name)
    return arguments
