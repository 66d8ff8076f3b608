"""A callback that evaluates the actor at checkpoints and records times, rewards, accuracies and episodes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap.predictor.learned import LearnedPredictorMixin

#: Training steps between two points of a curve.
INTERVAL = 25
#: Training steps over which the reward of a point is averaged (Fig. 4a).
WINDOW = 100
#: Attributes of a recorder that make up its state.
RECORDED = ("laps", "times", "curve", "episodes", "_due", "_rewards", "_accuracies", "_length", "_total", "_began")
TIME_COLUMNS = ["checkpoint", "wall_seconds", "training_seconds", "process_seconds"]
#: ``mistakes`` counts the non-permissible actions so far; it is missing where nothing is labelled, and in older runs.
CURVE_COLUMNS = ["step", "reward", "accuracy", "lowest_accuracy", "mistakes"]
EPISODE_COLUMNS = ["end", "length", "total_reward", "ended"]


class Clock:
    """Seconds since the process began, without those of evaluations.

    :param began: start of the process in ``time.monotonic`` seconds
    """

    def __init__(self, began: float):
        self._wall, self._process = began, 0.0

    def wall(self) -> float:
        """Wall-clock seconds."""
        return time.monotonic() - self._wall

    def process(self) -> float:
        """Processor seconds of this process."""
        return time.process_time() - self._process

    def state(self) -> tuple[float, float]:
        """Seconds so far, for :meth:`restore`."""
        return self.wall(), self.process()

    def restore(self, state: tuple[float, float]) -> None:
        """Continues from the seconds of an earlier process; those of this one so far do not count."""
        wall, process = state
        self._wall, self._process = time.monotonic() - wall, time.process_time() - process

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stops the clock for the duration of the block."""
        wall, process = self.wall(), self.process()
        yield
        self._wall, self._process = time.monotonic() - wall, time.process_time() - process


class Recorder(BaseCallback):
    """Records a training run without changing it.

    :param checkpoints: steps after which ``evaluate`` is called with the model
    :param evaluate: a function of the model and the checkpoint: rows of the table of laps, without the checkpoint
    :param clock: is stopped during evaluations
    """

    def __init__(self, checkpoints: list[int], evaluate: Callable[[Any, int], list[list[Any]]], clock: Clock):
        super().__init__()
        self.laps: list[list[Any]] = []
        self.times: list[list[Any]] = []
        self.curve: list[list[Any]] = []
        self.episodes: list[list[Any]] = []
        self._due = deque(checkpoints)
        self._evaluate, self._clock = evaluate, clock
        self._rewards: deque[float] = deque(maxlen=WINDOW)
        self._accuracies: list[float] = []
        self._length, self._total = 0, 0.0

        self._began: float | None = None

    def state(self) -> dict[str, Any]:
        """What was recorded so far, for :meth:`restore`."""
        return {name: getattr(self, name) for name in RECORDED}

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from what an earlier process recorded."""
        for name in RECORDED:
            setattr(self, name, state[name])

    def _on_training_start(self) -> None:
        if self._began is None:
            self._began = self._clock.wall()

    def _on_rollout_start(self) -> None:
        # The gradient steps of the last rollout are complete by now, which they are not in `_on_step`.
        while self._due and self.num_timesteps >= self._due[0]:
            self._checkpoint()

    def _on_training_end(self) -> None:
        while self._due:
            self._checkpoint()
        if self._length:
            self._end_episode("unfinished")

    def _checkpoint(self) -> None:
        checkpoint = self._due.popleft()
        wall = self._clock.wall()
        times = [wall, wall - (self._began or 0.0), self._clock.process()]
        self.times.append([checkpoint, *(round(seconds, 3) for seconds in times)])
        with self._clock.stopped():
            self.laps += [[checkpoint, *row] for row in self._evaluate(self.model, checkpoint)]

    def _on_step(self) -> bool:
        [info], [done] = self.locals["infos"], self.locals["dones"]
        reward = float(self.locals["rewards"][0])
        self._rewards.append(reward)
        self._accuracies.append(getattr(self.model, "validation_accuracy", float("nan")))
        self._length, self._total = self._length + 1, self._total + reward
        if done:
            self._end_episode(how_ended(info))
        if self.num_timesteps % INTERVAL == 0:
            self._point()
        return True

    def _end_episode(self, how: str) -> None:
        self.episodes.append([self.num_timesteps, self._length, round(self._total, 2), how])
        self._length, self._total = 0, 0.0

    def _point(self) -> None:
        known = [accuracy for accuracy in self._accuracies if not np.isnan(accuracy)]
        self._accuracies = []
        accuracy = [round(sum(known) / len(known), 4), round(min(known), 4)] if known else [None, None]
        mistakes = self.model.knowledge.seen[0] if isinstance(self.model, LearnedPredictorMixin) else None
        self.curve.append([self.num_timesteps, round(sum(self._rewards) / len(self._rewards), 3), *accuracy, mistakes])


def how_ended(info: dict[str, Any]) -> str:
    """The reason why an episode ended, from the info of its last step."""
    if info.get("TimeLimit.truncated"):
        return "truncated"
    if "off_track" not in info:
        return "terminated"
    if info["off_track"]:
        return "off track"
    return "backwards" if math.cos(info["angle"]) < 0 else "still"
