"""Settings of torch that hold only for the networks of this package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th


@contextmanager
def own_generators(seed: int, device: th.device) -> Iterator[None]:
    """Seeds torch's global generators, of the CPU and of ``device``, within the block, and restores them after it.

    What draws inside, such as the initial weights of a network or dropout, shifts no generator of the base algorithm.
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

    Weight decay and Adam shrink what belongs to inactive units towards zero for ever, and processors compute with
    denormal numbers so slowly that a fit takes seven times as long after 1,000 steps. The setting of the caller,
    whose own networks must not change by a bit, is kept. It holds for the calling thread alone, so that the gain
    needs one thread for each process, as in ``OMP_NUM_THREADS=1``.
    """
    already = (th.tensor(1e-310, dtype=th.float64) * 1.0).item() == 0.0
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(already)
