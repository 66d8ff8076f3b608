"""Action noise from a description that YAML can hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise

#: Classes of noise by the ``"type"`` in a description.
NOISES: dict[str, Callable[..., ActionNoise]] = {
    "normal": NormalActionNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise,
}


def make_action_noise(description: Mapping[str, Any], action_space: spaces.Space[Any]) -> ActionNoise:
    """Builds the noise that a mapping describes, with the shape of the action space.

    :raise ValueError: for an unknown type, a missing ``"sigma"`` or a wrong setting
    """
    settings = dict(description)
    kind = settings.pop("type", None)
    if kind not in NOISES:
        raise ValueError(f"`action_noise` has type {kind!r}, but must be one of {', '.join(map(repr, NOISES))}.")
    if "sigma" not in settings:
        raise ValueError("`action_noise` needs 'sigma', the scale of the noise in scaled actions (-1 to 1).")
    if not np.all(np.isreal(settings["sigma"])) or np.any(np.asarray(settings["sigma"]) < 0):
        raise ValueError(f"`action_noise`: 'sigma' must be a number of at least 0, but is {settings['sigma']!r}.")
    ones = np.ones(action_space.shape or ())
    mean = settings.pop("mean", 0.0) * ones
    try:
        return NOISES[kind](mean, settings.pop("sigma") * ones, **settings)
    except TypeError as error:
        raise ValueError(f"`action_noise` of type {kind!r}: {error}.") from error
