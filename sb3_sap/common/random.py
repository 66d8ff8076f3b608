"""Separate random generators, so that guidance draws nothing from the generators of SB3."""

from __future__ import annotations

from typing import Literal

import numpy as np

Stream = Literal["exploration", "knowledge", "predictor", "prior", "risk"]
_STREAMS: tuple[Stream, ...] = ("exploration", "knowledge", "predictor", "prior", "risk")


def make_rng(seed: int | None, stream: Stream) -> np.random.Generator:
    """A generator for one purpose: the same seed gives the same draws, and each purpose has its own."""
    return np.random.default_rng(None if seed is None else [seed, _STREAMS.index(stream)])
