"""What happens in one cell: one training run that yields all that the tables and figures need."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap.benchmark.cells import Cell
from sb3_sap.benchmark.learners import make_model
from sb3_sap.benchmark.linear import LinearFeedback
from sb3_sap.benchmark.rule import random_permissible
from sb3_sap.benchmark.tasks import RETURN_COLUMNS, evaluation
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS, lap, lap_env

#: Steps between two points of a curve, and steps over which its reward is averaged (Fig. 4a).
INTERVAL, WINDOW = 25, 100
LAP_COLUMNS = ["checkpoint", "track", "lap_done", "covered", "total_reward", "score", "steps"]
TIME_COLUMNS = ["checkpoint", "wall_seconds", "training_seconds", "process_seconds"]
CURVE_COLUMNS = ["step", "reward", "accuracy", "lowest_accuracy"]
EPISODE_COLUMNS = ["end", "length", "total_reward", "ended"]


class Clock:
    """Seconds since the process began, those of evaluation left out."""

    def __init__(self, began: float):
        self._wall, self._process = began, 0.0

    def wall(self) -> float:
        """Seconds that a user waited."""
        return time.monotonic() - self._wall

    def process(self) -> float:
        """Processor seconds of this process."""
        return time.process_time() - self._process

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """What happens meanwhile does not count."""
        wall, process = self.wall(), self.process()
        yield
        self._wall, self._process = time.monotonic() - wall, time.process_time() - process


class Recorder(BaseCallback):
    """Watches a training run without touching it.

    :param checkpoints: steps after which ``evaluate`` is called with the model
    :param evaluate: returns rows that follow the checkpoint in ``LAP_COLUMNS``
    """

    def __init__(self, checkpoints: list[int], evaluate: Callable[[Any], list[list[Any]]], clock: Clock):
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

    def _on_training_start(self) -> None:
        self._began = self._clock.wall()

    def _on_rollout_start(self) -> None:
        # The gradient steps of the last rollout have been taken by now; in `_on_step` they have not.
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
        times = [wall, wall - self._began, self._clock.process()]
        self.times.append([checkpoint, *(round(seconds, 3) for seconds in times)])
        with self._clock.stopped():
            self.laps += [[checkpoint, *row] for row in self._evaluate(self.model)]

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
        self.curve.append([self.num_timesteps, round(sum(self._rewards) / len(self._rewards), 3), *accuracy])


def how_ended(info: dict[str, Any]) -> str:
    """What ended an episode, from the info of its last step."""
    if info.get("TimeLimit.truncated"):
        return "truncated"
    if "off_track" not in info:
        return "terminated"
    if info["off_track"]:
        return "off track"
    return "backwards" if math.cos(info["angle"]) < 0 else "still"


def run_cell(cell: Cell, began: float) -> dict[str, Any]:
    """Trains, evaluates and returns the tables of the cell, as lists that JSON can hold.

    :param began: when the process was started, in ``time.monotonic`` seconds
    """
    clock = Clock(began)
    if cell.simulator in ENVIRONMENTS:
        evaluate, columns = _laps(cell), LAP_COLUMNS
    else:
        evaluate, columns = evaluation(cell.simulator, cell.algo, cell.training, cell.tracks), RETURN_COLUMNS
    recorder = Recorder(cell.checkpoints, evaluate, clock)
    if cell.algo == "linear":
        recorder.laps = [[0, *row] for row in evaluate(LinearFeedback(**cell.settings))]
    elif cell.algo == "rule":
        played = random_permissible(cell.simulator, cell.settings["ap_function"], cell.training, cell.tracks, cell.seed)
        recorder.laps = [[0, *row] for row in played]
    else:
        env = make_env(ENVIRONMENTS.get(cell.simulator, cell.simulator), **cell.training)
        model = make_model(cell.algo, env, cell.settings, cell.seed)
        model.learn(cell.steps, callback=recorder)
    return {
        "laps": {"columns": columns, "data": recorder.laps},
        "times": {"columns": TIME_COLUMNS, "data": recorder.times},
        "curve": {"columns": CURVE_COLUMNS, "data": recorder.curve},
        "episodes": {"columns": EPISODE_COLUMNS, "data": recorder.episodes},
    }


def _laps(cell: Cell) -> Callable[[Any], list[list[Any]]]:
    """A function that drives a lap of every test track: rows that follow the checkpoint in ``LAP_COLUMNS``."""
    tests: dict[str, gym.Env[Any, Any]] = {}

    def evaluate(policy: Any) -> list[list[Any]]:
        if not tests:
            tests.update({track: lap_env(track, cell.simulator, **cell.task) for track in cell.tracks})
        driven = [lap(policy, env, track) for track, env in tests.items()]
        return [
            [r.track, r.lap_done, round(r.covered, 6), round(r.total_reward, 2), round(r.score, 6), r.steps]
            for r in driven
        ]

    return evaluate
