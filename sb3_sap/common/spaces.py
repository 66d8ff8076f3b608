"""Checks of action and observation spaces, with a clear error where SB3 would go wrong or fail later."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

#: Scaled actions that must be the same after unscaling and scaling, and the tolerance.
PROBES, TOLERANCE = np.linspace(-1, 1, 9), 1e-3
#: Observation spaces, alone or as entries of a ``Dict``, for which SB3 has networks.
OBSERVATIONS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def check_action_space(algorithm: str, space: spaces.Space[Any], discrete: bool | None) -> None:
    """Checks that an algorithm can use an action space.

    :param algorithm: its name, for the error message
    :param discrete: whether it needs a ``Discrete`` space, else a ``Box``; ``None``: it takes either
    :raise ValueError: if the algorithm cannot use the space
    """
    kinds = {True: "discrete (Discrete)", False: "continuous (Box)", None: "bounded Box or a Discrete"}
    wanted = {True: (spaces.Discrete,), False: (spaces.Box,), None: (spaces.Box, spaces.Discrete)}
    if not isinstance(space, wanted[discrete]):
        raise ValueError(
            f"{algorithm} needs an `env` with a {kinds[discrete]} action space, but this one's is {space}: "
            f"{_hint(space)}."
        )
    if isinstance(space, spaces.Discrete):
        if space.start != 0:
            raise ValueError(
                f"{algorithm} needs actions that count from 0, as SB3's algorithms do, but this `env` has {space}: "
                f"wrap it in gymnasium.wrappers.TransformAction(env, lambda a: a + {space.start}, "
                f"gymnasium.spaces.Discrete({space.n}))."
            )
    elif isinstance(space, spaces.Box):
        _check_box(algorithm, space)


def check_any_action_space(algorithm: str, space: spaces.Space[Any]) -> None:
    """Checks that an on-policy algorithm can use an action space.

    :param algorithm: its name, for the error message
    :raise ValueError: if the algorithm cannot use the space
    """
    if isinstance(space, (spaces.Box, spaces.Discrete)):
        check_action_space(algorithm, space, discrete=None)
        return
    if not isinstance(space, (spaces.MultiDiscrete, spaces.MultiBinary)) or len(space.shape) != 1:
        raise ValueError(
            f"{algorithm} needs an `env` with a Box, Discrete, or one-dimensional MultiDiscrete or MultiBinary action "
            f"space, but this one's is {space}: wrap the environment in gymnasium.wrappers.TransformAction."
        )
    if np.any(getattr(space, "start", 0)):
        raise ValueError(
            f"{algorithm} needs actions that count from 0, as SB3's algorithms do, but this `env` has {space}: add "
            "`start` in gymnasium.wrappers.TransformAction."
        )


def sizes_of(space: spaces.Space[Any]) -> list[int]:
    """The number of choices in each dimension of a finite action space."""
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    return list(space.nvec.tolist()) if isinstance(space, spaces.MultiDiscrete) else [2] * math.prod(space.shape or ())


def joint_actions(space: spaces.Space[Any]) -> np.ndarray[Any, Any]:
    """(k, *action_shape) every action of a finite space, the last dimension fastest."""
    sizes = sizes_of(space)
    actions = np.stack(np.unravel_index(np.arange(math.prod(sizes)), sizes), axis=1)
    return actions.reshape(-1, *(space.shape or ())).astype(space.dtype)


def unscaled(action_space: spaces.Space[Any], action: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Actions in the environment's units, of a ``Box`` from those scaled to [-1, 1]."""
    if not isinstance(action_space, spaces.Box):
        return action
    low, high = action_space.low, action_space.high
    return np.asarray(low + 0.5 * (action + 1.0) * (high - low))


def _hint(space: spaces.Space[Any]) -> str:
    if isinstance(space, spaces.Discrete):
        return "choose DQNAP or QRDQNAP"
    if isinstance(space, spaces.Box):
        return "choose an algorithm for continuous actions, such as SACAP"
    return (
        "no off-policy algorithm of SB3 takes it, so wrap the environment in gymnasium.wrappers.TransformAction, with "
        "a Discrete space that numbers the combinations or a Box"
    )


def _check_box(algorithm: str, space: spaces.Box) -> None:
    needs = f"{algorithm} needs an `env` whose actions"
    if not np.issubdtype(space.dtype, np.floating):
        raise ValueError(
            f"{needs} are floating-point numbers, but this one's action space is {space}: its actions would be "
            "truncated to whole numbers unnoticed, so make its dtype np.float32 and round inside the environment."
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise ValueError(
            f"{needs} are bounded, but this one's action space is {space}: wrap it in "
            "gymnasium.wrappers.RescaleAction or set finite bounds."
        )
    if not (space.low < space.high).all():
        raise ValueError(
            f"{needs} can vary, but in this one's action space {space} a lower bound is not below its upper one: leave "
            "out the dimensions that are fixed."
        )
    probes = PROBES.astype(space.dtype).reshape(-1, *[1] * len(space.shape))
    with np.errstate(over="ignore", invalid="ignore"):
        # As SB3's policies scale actions, in the precision of the space.
        actions = space.low + 0.5 * (probes + 1.0) * (space.high - space.low)
        back = 2.0 * ((actions - space.low) / (space.high - space.low)) - 1.0
        exact = np.abs(back - probes) <= TOLERANCE
    if not exact.all():  # an overflow gives inf or NaN, which is not within the tolerance
        raise ValueError(
            f"{needs} can be scaled to [-1, 1] and back, but the bounds of {space} are too large or too close "
            f"together for {space.dtype}: let the environment take actions from -1 to 1 and rescale them itself."
        )


def check_observation_space(algorithm: str, space: spaces.Space[Any], key: str = "") -> None:
    """Checks that SB3 can use the observations and does not misread them.

    :param algorithm: its name, for the error message
    :raise ValueError: if the algorithm cannot use the space
    """
    where = f"the entry {key!r} of its observation space" if key else "its observation space"
    if isinstance(space, spaces.Dict) and not key:
        for name, entry in space.spaces.items():
            check_observation_space(algorithm, entry, name)
    elif not isinstance(space, OBSERVATIONS) or np.ndim(getattr(space, "nvec", 0)) > 1:
        raise ValueError(
            f"{algorithm} needs an `env` with observations that SB3 takes (Box, Discrete, one-dimensional "
            f"MultiDiscrete, MultiBinary, or a Dict of them), but {where} is {space}: wrap it in "
            "gymnasium.wrappers.FlattenObservation."
        )
    elif np.any(getattr(space, "start", 0)):
        raise ValueError(
            f"{algorithm} needs an `env` whose observations count from 0, as SB3 encodes them one-hot, but {where} is "
            f"{space}: subtract `start` in gymnasium.wrappers.TransformObservation."
        )
