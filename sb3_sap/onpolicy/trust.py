"""How far the labels of an on-policy algorithm can be trusted: as far as its advantages agree with them."""

from __future__ import annotations

import math

import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray

#: Steps over which the agreement is measured, if a rollout has not more.
WINDOW = 512


class Agreement:
    """The correlation between labels and advantages, less twice its standard error.

    A mistake's advantage is negative (Definition 3). E predicts a label that is wrong, or that a good policy sometimes
    violates, as well as any other, so that its accuracy cannot tell; the advantages can. The correlation falls while a
    policy learns, because what is left to improve has less and less to do with the labels.
    """

    def __init__(self) -> None:
        self._labels: BoolArray = np.zeros(0, dtype=bool)
        self._advantages: FloatArray = np.zeros(0, dtype=np.float32)

    def update(self, labels: BoolArray, advantages: FloatArray) -> None:
        """Takes in a rollout.

        :param labels: (steps, n_envs) of the executed actions
        :param advantages: the same shape
        """
        kept = max(WINDOW, labels.size)
        self._labels = np.concatenate([self._labels, labels.ravel()])[-kept:]
        self._advantages = np.concatenate([self._advantages, advantages.ravel()])[-kept:]

    def __float__(self) -> float:
        """From 0, no agreement that is significant, to 1."""
        n = len(self._labels)
        if n == 0 or not self._labels.any() or self._labels.all() or not self._advantages.std() > 0:
            return 0.0
        correlation = float(np.corrcoef(self._labels, self._advantages)[0, 1])
        return max(0.0, correlation - 2 / math.sqrt(n))
