"""Which slots of a store hold which class, and which slot a new example takes."""

from __future__ import annotations

from typing import Any

import numpy as np


class ClassSlots:
    """Assigns the slots of a store to two classes.

    When the store is full, a new tuple replaces the oldest of its class; if its class has too few, it replaces the
    oldest of the other class, which is then the larger one.

    :param capacity: number of slots
    :param least: number of tuples below which a class still grows in a full store, at most half of the capacity
    """

    def __init__(self, capacity: int, least: int = 1):
        self.capacity = capacity
        self.least = max(1, min(least, capacity // 2))
        self.counts = [0, 0]
        self._slots = np.zeros((2, capacity), dtype=np.int64)
        self._oldest = [0, 0]

    def __len__(self) -> int:
        return sum(self.counts)

    def slots(self, label: int) -> np.ndarray[Any, np.dtype[np.int64]]:
        """The slots that hold a tuple of class ``label``, in no promised order."""
        return self._slots[label, : self.counts[label]]

    def claim(self, label: int) -> int:
        """The slot for a new tuple of class ``label``."""
        if len(self) < self.capacity:
            return self._append(label, len(self))
        if self.counts[label] < self.least:
            return self._append(label, self._remove_oldest(1 - label))
        position = self._oldest[label]
        self._oldest[label] = (position + 1) % self.counts[label]
        return int(self._slots[label, position])

    def _append(self, label: int, slot: int) -> int:
        # Only a class that never wrapped around, or was sorted by age since, grows: its newest tuple is also the last.
        self._slots[label, self.counts[label]] = slot
        self.counts[label] += 1
        return slot

    def _remove_oldest(self, label: int) -> int:
        in_age_order = np.roll(self.slots(label), -self._oldest[label])
        self.counts[label] -= 1
        self._slots[label, : self.counts[label]] = in_age_order[1:]
        self._oldest[label] = 0
        return int(in_age_order[0])


class Reservoir:
    """Slots of two classes, half of the store for each, that hold a random sample of all tuples ever offered.

    Every tuple of a class is among those kept with the same probability (Vitter 1985, algorithm R).

    :param capacity: number of slots
    """

    def __init__(self, capacity: int):
        self.capacity = capacity
        self.quota = capacity // 2
        self.offered = [0, 0]

    @property
    def counts(self) -> list[int]:
        """The number of tuples kept of each class."""
        return [min(self.quota, offered) for offered in self.offered]

    def __len__(self) -> int:
        return sum(self.counts)

    def slots(self, label: int) -> np.ndarray[Any, np.dtype[np.int64]]:
        """The slots that hold a tuple of class ``label``."""
        return label * self.quota + np.arange(self.counts[label])

    def claim(self, label: int, n: int, rng: np.random.Generator) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Which of n new tuples of class ``label`` are kept, and the slots of those, where a later one goes first."""
        numbers = self.offered[label] + np.arange(n)
        places = np.where(numbers < self.quota, numbers, rng.integers(0, numbers + 1))
        kept = np.flatnonzero(places < self.quota)
        self.offered[label] += n
        return kept, label * self.quota + places[kept]
