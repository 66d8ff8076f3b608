"""Settings of torch that hold only for the networks of this package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th


@contextmanager
def own_generators(seed: int, device: th.device) -> Iterator[None]:
    """Seeds torch's global generators, of the CPU and of ``device``, within the block, and restores them after it.

    Random draws inside, such as those of initial weights or of dropout, shift no generator of the base algorithm.
    """
    cuda = device.type == "cuda"
    with th.random.fork_rng(devices=[device] if cuda else []):
        th.default_generator.manual_seed(seed)
        if cuda:
            with th.cuda.device(device):
                th.cuda.manual_seed(seed)
        yield


@contextmanager
def flush_denormals() -> Iterator[None]:
    """Rounds numbers below 1e-38 to zero within the block.

    Weight decay and Adam shrink the weights and moments of inactive units towards zero for ever. Processors are slow
    with denormal numbers: after 1,000 steps a fit would take seven times as long. The caller's setting is restored,
    because the base algorithm's results must not change by a bit. The setting is one of the calling thread, so that
    the gain needs one thread per process, as with ``OMP_NUM_THREADS=1``.
    """
    before = (th.tensor(1e-310, dtype=th.float64) * 1.0).item() == 0.0
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(before)
