"""The known masks of the states of a rollout."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sb3_sap.common.arrays import BoolArray
from sb3_sap.guidance.masks import joint_masks


class KnownMasks:
    """Known masks by state: those of now while actions are chosen, in an update those of the rollout.

    A mask has a value for each combination, or, if they come so, for each choice of each dimension.

    :param sizes: the number of choices in each dimension of the action
    """

    def __init__(self, sizes: list[int]):
        self.sizes = sizes
        #: The masks of the states in which actions are chosen, (n, width); ``None``: there are none, or the update
        #: evaluates actions that were chosen before.
        self.now: Callable[[], BoolArray] | None = None
        self._of_states: dict[bytes, BoolArray] = {}

    def of(self, states: list[bytes]) -> BoolArray | None:
        """(n, width) bool; ``None``: nothing is known.

        :raise RuntimeError: if a state is not one of the rollout's
        """
        if self.now is not None:
            masks = self.now()
            for state, mask in zip(states, masks, strict=True):
                # What VecNormalize clips may look the same to the policy and have another mask.
                self._of_states[state] = mask | self._of_states.get(state, mask)
            return masks
        if not self._of_states:
            return None
        anything = np.ones_like(next(iter(self._of_states.values())))
        unknown = [state for state in states if state not in self._of_states]
        if any(state.strip(b"\0") for state in unknown):  # zeros pad the sequences of recurrent policies
            raise RuntimeError(
                "The update evaluates an observation in which no action was chosen, so that its mask is not known: "
                "`permissible_actions` cannot be used with a rollout buffer that changes observations."
            )
        return np.stack([self._of_states.get(state, anything) for state in states])

    def of_combinations(self, states: list[bytes]) -> BoolArray | None:
        """(n, k) bool, one value for each combination."""
        found, sizes = self.of(states), self.sizes
        if found is None or len(sizes) == 1 or found.shape[1] != sum(sizes):
            return found
        return joint_masks(found, sizes)
