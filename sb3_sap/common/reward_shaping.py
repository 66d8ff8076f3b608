"""What a label or a potential adds to the reward: a penalty for mistakes, and potential-based shaping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray, Observations, copy_observation
from sb3_sap.common.errors import is_number


class Potential(Protocol):
    """How good states are, Φ(s): the larger the better.

    :param obs: raw (never normalised) observations, (n, *obs_shape)
    :return: (n,) finite numbers, in units of the reward
    """

    def __call__(self, obs: Observations, /) -> FloatArray: ...


class PotentialError(ValueError):
    """A potential raised an error, or returned something other than a finite number for each state."""


@dataclass(frozen=True)
class RewardShaping:
    """The difference between the reward that is learned from and the reward of the environment.

    A penalty changes which policy is optimal unless the label is sound (Definition 3). Potential-based shaping,
    γ Φ(s') - Φ(s), does not (Ng, Harada and Russell 1999), provided that Φ of a terminal state is 0 while a truncated
    episode bootstraps from its last state (Grześ 2017).

    :param penalty: c, subtracted where the action was not permissible
    :param potential: Φ, a :class:`Potential`
    :param gamma: γ of the algorithm
    """

    penalty: float = 0.0
    potential: Potential | None = None
    gamma: float = 0.99

    def __post_init__(self) -> None:
        if not (is_number(self.penalty) and 0 <= self.penalty < np.inf):
            raise ValueError(f"`penalty` must be a number of at least 0, but is {self.penalty!r}.")

    def __bool__(self) -> bool:
        """Whether there is any difference."""
        return self.penalty > 0 or self.potential is not None

    def difference(
        self, labels: BoolArray | None, obs: Observations, next_obs: Observations, terminal: BoolArray
    ) -> FloatArray:
        """What is added to the rewards of n transitions.

        :param labels: (n,) False where the action was a mistake; None: there are no labels, and no penalty
        :param obs: s, raw, (n, *obs_shape)
        :param next_obs: s', raw, (n, *obs_shape)
        :param terminal: (n,) True where the episode terminated, False where it goes on or was truncated
        :return: (n,)
        """
        added = np.zeros(len(terminal))
        if labels is not None:
            added -= self.penalty * ~labels
        if self.potential is not None:
            later, now = (query_potential(self.potential, o, len(terminal)) for o in (next_obs, obs))
            added += self.gamma * np.where(terminal, 0.0, later) - now
        return added


def query_potential(potential: Callable[..., Any], obs: Observations, n: int) -> FloatArray:
    """Calls a user's potential with a batch of observations and checks what it returns.

    :return: (n,)
    :raise PotentialError: with one sentence
    """
    name = getattr(potential, "__name__", repr(potential))
    try:
        values = np.asarray(potential(copy_observation(obs)))
    except Exception as error:
        raise PotentialError(
            f"`potential` {name} raised {type(error).__name__}: {error}. It is called with a batch of n = {n} "
            "observations."
        ) from error
    if values.shape != (n,) or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise PotentialError(
            f"`potential` {name} must return {n} finite numbers, one for each observation of the batch, but returned "
            f"an array of shape {values.shape} and type {values.dtype}"
            + (", with values that are not finite." if values.dtype.kind == "f" and values.shape == (n,) else ".")
        )
    return values.astype(np.float64)
