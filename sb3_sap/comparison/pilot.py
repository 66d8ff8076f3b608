"""How many steps fit into the time that a user gives a comparison."""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from sb3_sap.comparison.worker import Job, run_in_process
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS

#: Minimum number of trained steps of a trial, and of a run beyond those that the algorithm takes before it learns.
TRIED = 200
#: Minimum number of rollouts of a run, after each of which an on-policy algorithm learns.
ROLLOUTS = 4
#: Minimum number of seconds to import the libraries and build a model.
START = 4.0


def steps_within(minutes: float, trials: list[Job], seeds: int, jobs: int) -> int:
    """The number of steps with which all runs together take about that long.

    :param trials: one run of each way
    :param seeds: runs of each way
    :param jobs: runs side by side
    :raise ValueError: if the time does not suffice for a trial's steps
    """
    warm_up = max(_warm_up(job) for job in trials)
    fewest = warm_up + TRIED
    if trials[0].algo in ON_POLICY_ALGORITHMS:
        fewest = max(fewest, ROLLOUTS * trials[0].rollout)
    began = time.monotonic()
    with ThreadPoolExecutor(jobs) as pool:
        measured = list(pool.map(lambda job: _measure(job, warm_up), trials))
    spent = time.monotonic() - began
    costs = [step for step, _, _ in measured]
    fixed = [
        start + episode * job.episodes * job.evaluations
        for job, (_, episode, start) in zip(trials, measured, strict=True)
    ]
    available = (60.0 * minutes - spent) * jobs / seeds - sum(fixed)
    steps = int(available / sum(costs))
    if steps < fewest:
        needed = (spent + (sum(fixed) + sum(costs) * fewest) * seeds / jobs) / 60
        raise ValueError(
            f"{minutes:g} minutes suffice for {max(0, steps)} steps of each run, which is too few to compare: give at "
            f"least {math.ceil(needed)} minutes, or fewer `seeds`, or the number of `steps`."
        )
    return steps // trials[0].rollout * trials[0].rollout


def _warm_up(job: Job) -> int:
    """The steps that are taken before the first gradient step, which cost next to nothing."""
    return 0 if job.algo in ON_POLICY_ALGORITHMS else int(job.settings.get("learning_starts", 100))


def _measure(job: Job, warm_up: int) -> tuple[float, float, float]:
    """Seconds of a training step, of an evaluation episode, and of everything before the first step."""
    # Two evaluations: the time between them is that of the steps between them and of the second one. In all of these
    # steps the algorithm learns, because the first evaluation comes after the warm-up.
    half = -(-max(warm_up, TRIED) // job.rollout) * job.rollout
    began = time.monotonic()
    moments: list[tuple[float, float]] = []
    for answer in run_in_process(replace(job, steps=2 * half, evaluations=2, episodes=1)):
        _check(answer)
        if "took" in answer:
            moments.append((time.monotonic() - began, float(answer["took"])))
    (first, _), (second, evaluation) = moments
    step = max(1e-5, (second - first - evaluation) / half)
    # Of the steps before the first evaluation those of the warm-up cost next to nothing.
    return step, evaluation, max(START, first - evaluation - (half - warm_up) * step)


def _check(answer: dict[str, Any]) -> None:
    if "error" in answer:
        raise ValueError(f"The trial run failed: {answer['error']}")
