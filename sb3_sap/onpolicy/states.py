"""What was found out in the states of a rollout, to be used again in its update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th


def keys_of(obs: Any) -> list[bytes]:
    """What tells each of n states from the others, for the policy, whose networks have single precision."""
    tensors = obs.values() if isinstance(obs, dict) else [obs]
    arrays = [(value.float() if value.is_floating_point() else value).cpu().numpy() for value in tensors]
    flat = [np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8) for array in arrays]
    joined = flat[0] if len(flat) == 1 else np.concatenate(flat, axis=1)
    return joined.view(f"V{joined.shape[1]}").ravel().tolist()


def keys_with(states: list[bytes], actions: th.Tensor) -> list[bytes]:
    """The same of n states with (n, action_dim) finite actions."""
    return [state + action.tobytes() for state, action in zip(states, actions.long().cpu().numpy(), strict=True)]


class Remembered:
    """Rows of an array by key. What was found for a key first holds as long as the object does."""

    def __init__(self) -> None:
        self._row_of: dict[bytes, int] = {}
        self._table: np.ndarray[Any, Any] = np.zeros((0, 0))  # with room for more
        self._held = 0

    def rows(self, keys: list[bytes], find: Callable[[list[int]], np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
        """(n, width) what is known of n keys.

        :param find: is called with the positions of the unknown keys, if there are any, and returns their rows
        """
        row_of = self._row_of
        try:  # in an update all are known
            return self._table[[row_of[key] for key in keys]]
        except KeyError:
            new = [position for position, key in enumerate(keys) if key not in row_of]
            self.add([keys[position] for position in new], find(new))
            return self._table[[row_of[key] for key in keys]]

    def add(self, keys: list[bytes], found: np.ndarray[Any, Any]) -> None:
        """Takes in the rows of keys that are unknown; of a key that occurs twice among them, the last."""
        first = self._held
        self._held += len(keys)
        if self._held > len(self._table):
            more = np.zeros((self._held, found.shape[1]), dtype=found.dtype)
            self._table = np.concatenate([self._table, more]) if first else more
        self._table[first : self._held] = found
        self._row_of.update(zip(keys, range(first, self._held), strict=True))

    def add_new(self, keys: list[bytes], found: np.ndarray[Any, Any]) -> bool:
        """Takes in the rows of those keys that are unknown. Whether all of them were, and each occurs once."""
        new = {key: position for position, key in reversed(list(enumerate(keys))) if key not in self._row_of}
        if new:
            self.add(list(new), found[list(new.values())])
        return len(new) == len(keys)

    def known(self, keys: list[bytes]) -> tuple[list[int], np.ndarray[Any, Any]]:
        """The positions of those keys that are known, and their rows."""
        found = [(position, self._row_of[key]) for position, key in enumerate(keys) if key in self._row_of]
        return [position for position, _ in found], self._table[[row for _, row in found]]
