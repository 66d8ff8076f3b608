"""A table of a training run, with one row for each step, which survives Ctrl-C."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback


class TrainingLog(BaseCallback):
    """Collects one row of a tidy table for every training step, and ends the training once ``stop`` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []
        self.stop = False

    def _on_step(self) -> bool:
        [info], [reward] = self.locals["infos"], self.locals["rewards"]
        self.rows.append(
            {
                "step": self.num_timesteps,
                "episode": self.model._episode_num,
                "reward": float(reward),
                "permissible": info["permissible"],
                "off_track": info["off_track"],
                "track_pos": info["track_pos"],
                "validation_accuracy": getattr(self.model, "validation_accuracy", float("nan")),
                "alpha": getattr(self.model, "current_alpha", float("nan")),
            }
        )
        return not self.stop


@contextmanager
def ctrl_c_stops(log: TrainingLog) -> Iterator[None]:
    """Ends the training after the step in which Ctrl-C was pressed, and only then interrupts.

    An exception in the middle of a step can be lost in a destructor, or leave a buffer half written.
    """

    def stop(*_: object) -> None:
        log.stop = True

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if log.stop:
        raise KeyboardInterrupt
