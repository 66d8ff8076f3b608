"""``compare``: which use of a label is worth it on a user's own problem, within a given time."""

from __future__ import annotations

import os
import queue
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from gymnasium import spaces
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_sap.algorithms import guided_name
from sb3_sap.common.errors import is_number
from sb3_sap.common.functions import resolve
from sb3_sap.comparison.code import lines
from sb3_sap.comparison.decision import Comparison, write_evaluations
from sb3_sap.comparison.pilot import steps_within
from sb3_sap.comparison.ways import Way, ways
from sb3_sap.comparison.worker import Job, policy_for, run_in_process, stop_all
from sb3_sap.permissibility import does_not_lower

#: Evaluations of a run, at equal distances.
EVALUATIONS = 10


def compare(
    env: str | Callable[..., gym.Env[Any, Any]],
    ap_function: Callable[..., Any] | str | None = None,
    *,
    algo: str | None = None,
    potential: Callable[..., Any] | str | None = None,
    minutes: float = 10.0,
    steps: int | None = None,
    seeds: int = 5,
    first_seed: int = 0,
    episodes: int = 5,
    jobs: int | None = None,
    settings: Mapping[str, Any] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    out: Path | str | None = None,
    console: Console | None = None,
) -> Comparison:
    """Trains the base algorithm, the base with a reward penalty, and guided ones, on your environment, and decides.

    All runs of a comparison have equally many steps and the same settings of the base algorithm. Each is a process of
    its own with one thread.

    :param env: the id of an environment, or a function that makes one
    :param ap_function: f(s, a | s') or its dotted name; ``None``: the labels come from ``potential`` if there is one,
        else from ``info["permissible"]``
    :param algo: RL Zoo's name of a guided algorithm or of its base, such as ``"ppo_ap"`` or ``"ppo"``; ``None``:
        ``"sac_ap"`` for a ``Box`` of actions, ``"dqn_ap"`` for ``Discrete`` ones, ``"ppo_ap"`` for others
    :param potential: Φ or its dotted name; reward shaping with it is compared as well
    :param minutes: how long the comparison may take, about; the number of steps follows from it
    :param steps: training steps of each run instead; an on-policy algorithm takes whole rollouts
    :param seeds: number of runs of each way, at least 2
    :param first_seed: their seeds count from here
    :param episodes: episodes of an evaluation
    :param jobs: runs side by side; ``None``: as many as there are processors
    :param settings: arguments of the base algorithm's constructor, such as ``{"learning_rate": 1e-3}``
    :param env_kwargs: arguments of the environment
    :param out: folder in which evaluations, table, curves, decision and script are saved, the evaluations also if the
        comparison is interrupted; ``None``: nowhere
    :param console: shows the progress; ``None``: on standard output
    :return: the runs, the decision and the code to paste
    :raise ValueError: for an unknown algorithm, too little time, or a run that fails
    """
    for name, value, minimum in (
        ("seeds", seeds, 2),
        ("episodes", episodes, 1),
        ("steps", steps, 1),
        ("jobs", jobs, 1),
    ):
        if value is not None and not (isinstance(value, int) and value >= minimum):
            raise ValueError(f"`{name}` must be a whole number of at least {minimum}, but is {value!r}.")
    if not (is_number(minutes) and minutes > 0):
        raise ValueError(f"`minutes` must be a number above 0, but is {minutes!r}.")
    console = console or Console()
    job = Job(env, dict(env_kwargs or {}), algo or "", dict(settings or {}), 0, 0, EVALUATIONS, episodes)
    algo, policy, finite = _algorithm(algo, job)
    job = replace(job, algo=algo)
    compared = ways(algo, potential is not None, finite)
    jobs = jobs or len(os.sched_getaffinity(0))
    runs = [(way, _labelled(job, way, ap_function, potential)) for way in compared]
    if steps is None:
        console.print("A short trial of each way tells how many steps fit into the time.")
        steps = steps_within(minutes, [trial for _, trial in runs], seeds, jobs)
    sized = replace(job, steps=steps).in_rollouts()
    steps, evaluations, rollout = sized.steps, sized.evaluations, sized.rollout
    whole = f" in rollouts of {rollout:,}" if rollout > 1 else ""
    console.print(f"{len(compared)} ways, {seeds} seeds each, {steps:,} steps{whole}, {jobs} side by side")
    numbers = range(first_seed, first_seed + seeds)
    rows: list[dict[str, Any]] = []
    try:
        sized_runs = [(way, replace(run, steps=steps, evaluations=evaluations)) for way, run in runs]
        _train([(way, replace(run, seed=n)) for n in numbers for way, run in sized_runs], jobs, console, rows)
    finally:
        if out is not None:
            write_evaluations(Path(out), pd.DataFrame(rows))  # also if a run fails, or after Ctrl-C
    code = {way.name: lines(way, replace(job, steps=steps), policy, ap_function, potential) for way in compared}
    result = Comparison(compared, pd.DataFrame(rows), code)
    if out is not None:
        result.save(Path(out))
    return result


def _algorithm(algo: str | None, job: Job) -> tuple[str, str, bool]:
    """The algorithm, or that of the action space, SB3's policy for the observations, and whether actions are finite."""
    algo = None if algo is None else guided_name(algo)
    env = job.make_env()
    space = env.action_space
    finite = not isinstance(space, spaces.Box)
    algo = algo or {spaces.Box: "sac_ap", spaces.Discrete: "dqn_ap"}.get(type(space), "ppo_ap")
    policy = policy_for(env, algo)
    env.close()
    return algo, policy, finite


def _labelled(job: Job, way: Way, ap_function: Any, potential: Any) -> Job:
    """The job with the settings of a way; a potential shapes the reward in one way alone, and labels in all."""
    labels = {} if ap_function is None else {"ap_function": resolve(ap_function, "ap_function")}
    if potential is not None:
        potential = resolve(potential, "potential")
        labels = {"ap_function": does_not_lower(potential), **labels}
        labels |= {"potential": potential} if way.name == "shaping" else {}
    return replace(job, settings={**labels, **way.settings, **job.settings})


def _train(jobs: list[tuple[Way, Job]], side_by_side: int, console: Console, rows: list[dict[str, Any]]) -> None:
    """Runs all jobs, and adds a row for each evaluation to ``rows``."""
    answers: queue.Queue[tuple[Way, Job, dict[str, Any]]] = queue.Queue()

    def run(way: Way, job: Job) -> None:
        for answer in run_in_process(job):
            answers.put((way, job, answer))

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    running = len(jobs)
    with (
        Progress(*columns, console=console, disable=not console.is_terminal) as progress,
        ThreadPoolExecutor(side_by_side) as pool,
    ):
        task = progress.add_task("evaluations", total=sum(job.evaluations for _, job in jobs))
        for way, job in jobs:
            pool.submit(run, way, job)
        try:
            while running:
                way, job, answer = answers.get()
                if "error" in answer:
                    raise ValueError(f"The run {way.name!r} with seed {job.seed} failed: {answer['error']}")
                if "seconds" in answer:
                    running -= 1
                    last = _last_return(rows, way, job)
                    console.print(f"{way.name}, seed {job.seed}: mean return {last:.4g} after {job.steps:,} steps")
                    continue
                del answer["took"]
                rows.append({"way": way.name, "seed": job.seed, **answer})
                progress.update(task, advance=1, description=f"{way.name}, seed {job.seed}: {answer['return']:.4g}")
        finally:
            # Otherwise the pool would wait for the runs in progress, and begin those that wait.
            pool.shutdown(wait=False, cancel_futures=True)
            stop_all()


def _last_return(rows: list[dict[str, Any]], way: Way, job: Job) -> float:
    return next(float(row["return"]) for row in reversed(rows) if (row["way"], row["seed"]) == (way.name, job.seed))
