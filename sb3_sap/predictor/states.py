"""States that an AP predictor has learned in, which go with it: where its verdicts mean something."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_sap.predictor.knowledge import KnowledgeBuffer

#: Maximum number of states, and of bytes, that go with a predictor.
STATES, BYTES = 1_000, 4_000_000


def some_states(knowledge: KnowledgeBuffer) -> dict[str, th.Tensor] | None:
    """Raw observations spread evenly over K, (n, *obs_shape) for each key; of an array the key is ``""``.

    ``None``: K is empty.
    """
    observed = knowledge.training_observations()
    n = len(next(iter(observed.values())))
    if n == 0:
        return None
    size = sum(rows.itemsize * int(np.prod(rows.shape[1:])) for rows in observed.values())
    chosen = np.linspace(0, n - 1, max(1, min(n, STATES, BYTES // max(size, 1)))).astype(int)
    return {key: th.as_tensor(rows[chosen]) for key, rows in observed.items()}


def random_rows(states: dict[str, th.Tensor], n: int, rng: np.random.Generator) -> Any:
    """n of the same, with replacement, as arrays of raw observations."""
    chosen = rng.integers(len(next(iter(states.values()))), size=n)
    arrays = {key: rows.cpu().numpy()[chosen] for key, rows in states.items()}
    return arrays[""] if arrays.keys() == {""} else arrays
