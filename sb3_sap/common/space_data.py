"""Spaces as plain data, which a file can hold without pickle, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces


def space_to_data(space: spaces.Space[Any]) -> dict[str, Any]:
    """A space as names, numbers and tensors.

    :raise ValueError: for a kind of space that no algorithm of SB3 takes
    """
    kind = type(space).__name__
    if isinstance(space, spaces.Box):
        low, high = (th.as_tensor(np.asarray(bound, dtype=np.float64)) for bound in (space.low, space.high))
        return {"kind": kind, "low": low, "high": high, "dtype": str(space.dtype)}
    if isinstance(space, spaces.Discrete):
        return {"kind": kind, "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"kind": kind, "nvec": th.as_tensor(space.nvec), "start": th.as_tensor(space.start)}
    if isinstance(space, spaces.MultiBinary):
        return {"kind": kind, "shape": list(space.shape)}
    if isinstance(space, spaces.Dict):
        return {"kind": kind, "spaces": {key: space_to_data(one) for key, one in space.spaces.items()}}
    raise ValueError(f"{space} is no space that an algorithm of SB3 takes.")


def space_from_data(data: dict[str, Any]) -> spaces.Space[Any]:
    """The space that `space_to_data` described."""
    kind = data["kind"]
    if kind == "Box":
        dtype: Any = np.dtype(data["dtype"])
        return spaces.Box(data["low"].numpy().astype(dtype), data["high"].numpy().astype(dtype), dtype=dtype.type)
    if kind == "Discrete":
        return spaces.Discrete(data["n"], start=data["start"])
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(data["nvec"].numpy(), start=data["start"].numpy())
    if kind == "MultiBinary":
        return spaces.MultiBinary(data["shape"] if len(data["shape"]) > 1 else data["shape"][0])
    return spaces.Dict({key: space_from_data(one) for key, one in data["spaces"].items()})
