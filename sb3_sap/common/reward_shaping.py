"""What a label or a potential adds to the reward: a penalty for mistakes, and potential-based shaping."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray, Observations, copy_observation
from sb3_sap.common.errors import is_number

#: SB3's notation for a coefficient that is set from what is observed.
_AUTO = re.compile(r"auto(_\d+\.?\d*)?")


class Potential(Protocol):
    """How good states are, Φ(s): the larger the better.

    :param obs: raw (never normalised) observations, (n, *obs_shape)
    :return: (n,) finite numbers, in units of the reward
    """

    def __call__(self, obs: Observations, /) -> FloatArray: ...


class PotentialError(ValueError):
    """A potential raised an error, or returned something other than a finite number for each state."""


class RewardScale:
    """How large the rewards of the environment have been: the root of their mean square, or 1 while all are 0."""

    def __init__(self) -> None:
        self._count, self._squares = 0, 0.0

    def update(self, rewards: Any) -> None:
        """Takes in rewards, (n,)."""
        rewards = np.asarray(rewards, dtype=np.float64)
        self._count += rewards.size
        self._squares += float((rewards**2).sum())

    def __float__(self) -> float:
        return math.sqrt(self._squares / self._count) if self._squares else 1.0


@dataclass(frozen=True)
class RewardShaping:
    """The difference between the reward that is learned from and the reward of the environment.

    A penalty changes which policy is optimal unless the label is sound (Definition 3). Potential-based shaping,
    γ Φ(s') - Φ(s), does not (Ng, Harada and Russell 1999), provided that Φ of a terminal state is 0 while a truncated
    episode bootstraps from its last state (Grześ 2017).

    :param penalty: c, subtracted where the action was not permissible; ``"auto"``: as much as the rewards are large
        (:class:`RewardScale`), ``"auto_0.5"``: half as much
    :param potential: Φ, a :class:`Potential`
    :param gamma: γ of the algorithm
    :param entropy: what an algorithm that maximises entropy weighs it with at first, beside which rewards are large or
        small (:func:`~sb3_sap.common.entropy.entropy_weight`)
    """

    penalty: float | str = 0.0
    potential: Potential | None = None
    gamma: float = 0.99
    entropy: float = 0.0

    def __post_init__(self) -> None:
        named = isinstance(self.penalty, str) and _AUTO.fullmatch(self.penalty)
        if not (named or (is_number(self.penalty) and 0 <= float(self.penalty) < np.inf)):
            raise ValueError(
                f'`penalty` must be a number of at least 0, "auto" or "auto_<number>", but is {self.penalty!r}.'
            )

    @property
    def penalises(self) -> bool:
        """Whether there is a penalty."""
        return isinstance(self.penalty, str) or self.penalty > 0

    def __bool__(self) -> bool:
        """Whether there is any difference."""
        return self.penalises or self.potential is not None

    def penalty_at(self, scale: float) -> float:
        """c in units of the reward.

        :param scale: how large the rewards are
        """
        if not isinstance(self.penalty, str):
            return float(self.penalty)
        return max(scale, self.entropy) * float(self.penalty.removeprefix("auto").removeprefix("_") or 1)

    def of_labels(self, labels: BoolArray, scale: float = 1.0) -> FloatArray:
        """(n,) minus c for each mistake among (n,) labels, or among (n, k) labels of k parts of the action."""
        mistakes = ~labels
        return -self.penalty_at(scale) * (mistakes.sum(axis=1) if mistakes.ndim > 1 else mistakes)

    def difference(
        self,
        labels: BoolArray | None,
        obs: Observations,
        next_obs: Observations,
        terminal: BoolArray,
        scale: float = 1.0,
    ) -> FloatArray:
        """What is added to the rewards of n transitions.

        :param labels: (n,) False where the action was a mistake, or (n, k) for k parts of it; None: there are no
            labels, and no penalty
        :param obs: s, raw, (n, *obs_shape)
        :param next_obs: s', raw, (n, *obs_shape)
        :param terminal: (n,) True where the episode terminated, False where it goes on or was truncated
        :param scale: how large the rewards are, for a penalty of ``"auto"``
        :return: (n,)
        """
        added = np.zeros(len(terminal))
        if labels is not None:
            added += self.of_labels(labels, scale)
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
