"""Parts of an action that are judged separately, such as steering and pedal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces


@dataclass(frozen=True)
class ActionParts:
    """Names of parts, and the indices of their dimensions in the flattened action. No parts: the action is judged
    as a whole.
    """

    names: tuple[str, ...] = ()
    indices: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def of(cls, parts: Mapping[str, Sequence[int]] | None, space: spaces.Space[Any]) -> ActionParts:
        """Reads what a user wrote: ``{"steering": [0], "pedal": [1]}``. Dimensions in no part are never judged.

        :raise ValueError: if the parts are not disjoint lists of dimensions of the space
        """
        if parts is None:
            return cls()
        if isinstance(space, spaces.Discrete):
            raise ValueError(f"`action_parts` divide actions of several dimensions, but {space} has one: leave it out.")
        dimensions = int(np.prod(space.shape or ()))
        if not isinstance(parts, Mapping) or not parts:
            raise ValueError(f'`action_parts` must be like {{"steering": [0], "pedal": [1]}}, but is {parts!r}.')
        given: dict[Any, Any] = dict(parts)
        for name, indices in given.items():
            listed = isinstance(indices, (list, tuple, range, np.ndarray)) and len(indices) > 0
            if not listed or not all(isinstance(i, (int, np.integer)) and 0 <= i < dimensions for i in indices):
                raise ValueError(
                    f"`action_parts`[{name!r}] must be a list of dimensions of the action, from 0 to {dimensions - 1}, "
                    f"but is {indices!r}."
                )
        every = [int(i) for indices in parts.values() for i in indices]
        if len(set(every)) < len(every):
            raise ValueError(f"`action_parts` must be disjoint, but a dimension occurs twice in {dict(parts)!r}.")
        return cls(tuple(map(str, parts)), tuple(tuple(map(int, indices)) for indices in parts.values()))

    def __len__(self) -> int:
        return len(self.names)

    def as_dict(self) -> dict[str, list[int]] | None:
        """As a user writes it."""
        return {name: list(i) for name, i in zip(self.names, self.indices, strict=True)} if self.names else None
