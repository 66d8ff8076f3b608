"""Trains and evaluates one run, and returns the tables from which every report is made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th

from sb3_sap.benchmark.episodes import RETURN_COLUMNS, evaluation
from sb3_sap.benchmark.learners import is_on_policy, make_model
from sb3_sap.benchmark.linear import LinearFeedback
from sb3_sap.benchmark.oracle import oracle_episodes
from sb3_sap.benchmark.recorder import CURVE_COLUMNS, EPISODE_COLUMNS, TIME_COLUMNS, Clock, Recorder
from sb3_sap.benchmark.runs import Run
from sb3_sap.benchmark.snapshots import SnapshotCallback, resume
from sb3_sap.envs.torcs.scripted import ScriptedDriver
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS, lap, lap_env
from sb3_sap.evaluation.racing import RACING, race

LAP_COLUMNS = ["checkpoint", "track", "lap_done", "covered", "total_reward", "score", "steps"]
#: ``lap_time`` in s is that of a lap from the grid, and missing where it was not completed; the score is ``covered``.
RACE_COLUMNS = ["checkpoint", "track", "lap_done", "covered", "lap_time", "score", "steps"]


def train_and_evaluate(run: Run, began: float, snapshot: Path | None = None) -> dict[str, Any]:
    """Trains, evaluates, and returns the tables of the run as lists, which JSON can hold.

    :param began: start of the process in ``time.monotonic`` seconds
    :param snapshot: where a training in progress is saved every few minutes and continues from; None: nowhere
    """
    clock = Clock(began)
    if run.simulator in ENVIRONMENTS:
        evaluate, columns = _laps(run), LAP_COLUMNS
    elif run.simulator == RACING:
        evaluate, columns = _races(run), RACE_COLUMNS
    else:
        evaluate, columns = evaluation(run.simulator, run.algo, run.training, run.tracks), RETURN_COLUMNS
    recorder = Recorder(run.checkpoints, evaluate, clock)
    if run.algo == "linear":
        recorder.laps = [[0, *row] for row in evaluate(LinearFeedback(**run.settings))]
    elif run.algo == "scripted":
        recorder.laps = [[0, *row] for row in evaluate(ScriptedDriver(**run.settings), 0)]
    elif run.algo == "oracle":
        played = oracle_episodes(run.simulator, run.settings["ap_function"], run.training, run.tracks, run.seed)
        recorder.laps = [[0, *row] for row in played]
    else:
        env = make_env(ENVIRONMENTS.get(run.simulator, run.simulator), **run.training)
        model = make_model(run.algo, env, run.settings, run.seed)
        _learn(model, run.steps, recorder, clock, snapshot)
    return {
        "laps": {"columns": columns, "data": recorder.laps},
        "times": {"columns": TIME_COLUMNS, "data": recorder.times},
        "curve": {"columns": CURVE_COLUMNS, "data": recorder.curve},
        "episodes": {"columns": EPISODE_COLUMNS, "data": recorder.episodes},
    }


def _learn(model: Any, steps: int, recorder: Recorder, clock: Clock, path: Path | None) -> None:
    """Trains, from a snapshot if there is one; models of other libraries cannot be saved with their generators,
    and on-policy algorithms take a minute.
    """
    if path is None or not isinstance(model.policy, th.nn.Module) or is_on_policy(type(model)):
        model.learn(steps, callback=recorder)
        return
    snapshots = SnapshotCallback(path, recorder, clock)
    model = resume(path, model, snapshots, recorder, clock)
    remaining = steps - model.num_timesteps
    model.learn(remaining, callback=[recorder, snapshots], reset_num_timesteps=model.num_timesteps == 0)
    path.unlink(missing_ok=True)


def _laps(run: Run) -> Callable[..., list[list[Any]]]:
    """A function of a policy and a checkpoint, by default the last, that drives a lap of every test track.

    It returns rows of ``LAP_COLUMNS`` without the checkpoint.
    """
    tests: dict[str, gym.Env[Any, Any]] = {}

    def evaluate(policy: Any, checkpoint: int = run.checkpoints[-1]) -> list[list[Any]]:
        later = run.at_the_end if checkpoint < run.checkpoints[-1] else []
        if not tests:
            tests.update({track: lap_env(track, run.simulator, **run.task) for track in run.tracks})
        driven = [lap(policy, env, track) for track, env in tests.items() if track not in later]
        return [
            [r.track, r.lap_done, round(r.covered, 6), round(r.total_reward, 2), round(r.score, 6), r.steps]
            for r in driven
        ]

    return evaluate


def _races(run: Run) -> Callable[[Any, int], list[list[Any]]]:
    """The same for laps against the clock; rows of ``RACE_COLUMNS``."""

    def evaluate(policy: Any, checkpoint: int) -> list[list[Any]]:
        later = run.at_the_end if checkpoint < run.checkpoints[-1] else []
        rows = []
        for track in run.tracks:
            if track not in later:
                driven = race(policy, track, **run.task)
                covered = round(driven.covered, 6)
                time = None if driven.lap_time is None else round(driven.lap_time, 3)
                rows.append([track, time is not None, covered, time, covered, len(driven.steps)])
        return rows

    return evaluate
