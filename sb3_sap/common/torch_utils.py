"""Torch settings for the networks of this package alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th


@contextmanager
def flush_denormals() -> Iterator[None]:
    """Rounds numbers below 1e-38 to zero for a while.

    Weight decay and Adam shrink what belongs to inactive units towards zero for ever, and processors compute with
    denormal numbers so slowly that a fit takes seven times as long after 1,000 steps. The setting of the caller,
    whose own networks must not change by a bit, is kept.
    """
    already = (th.tensor(1e-310, dtype=th.float64) * 1.0).item() == 0.0
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(already)
