"""Trains one run of a comparison in a process of its own, and reports each evaluation as a line of JSON."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import cloudpickle
import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sap.algorithms import GUIDED_ALGORITHMS
from sb3_sap.benchmark.process import SINGLE_THREADED
from sb3_sap.evaluation.environments import make_env
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS

#: Seed of the evaluation episodes, the same in every run.
EVALUATION_SEED = 10_000
_running: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True)
class Job:
    """Everything that decides a run.

    :param env: id of an environment, or a function that makes one
    :param settings: constructor arguments
    """

    env: str | Callable[..., gym.Env[Any, Any]]
    env_kwargs: dict[str, Any]
    algo: str
    settings: dict[str, Any]
    seed: int
    steps: int
    evaluations: int
    episodes: int

    @property
    def rollout(self) -> int:
        """Steps after which the policy first changes, if it does not change at every step: 1, or a whole rollout."""
        if self.algo not in ON_POLICY_ALGORITHMS:
            return 1
        default = inspect.signature(ON_POLICY_ALGORITHMS[self.algo]).parameters["n_steps"].default
        given = self.settings.get("n_steps", default)
        return given if isinstance(given, int) and given > 0 else 1  # others are refused by the constructor

    def in_rollouts(self) -> Job:
        """The job with whole rollouts, as many as it takes, and no more evaluations than there are rollouts."""
        n = -(-self.steps // self.rollout)
        return replace(self, steps=n * self.rollout, evaluations=min(self.evaluations, n))

    @property
    def evaluated_at(self) -> list[int]:
        """The steps after which the policy is evaluated, at equal distances, and at the end of rollouts."""
        due = [self.steps * (i + 1) // self.evaluations for i in range(self.evaluations)]
        return [-(-step // self.rollout) * self.rollout for step in due]

    def make_env(self) -> gym.Env[Any, Any]:
        """A new environment."""
        return make_env(self.env, **self.env_kwargs) if isinstance(self.env, str) else self.env(**self.env_kwargs)


class Evaluations(BaseCallback):
    """Evaluates the policy at equal distances, alone unless the job says otherwise, and reports each evaluation."""

    def __init__(self, job: Job, report: Callable[[dict[str, Any]], None]):
        super().__init__()
        self._report, self._episodes = report, job.episodes
        self._due = job.evaluated_at
        self._env = DummyVecEnv([lambda: Monitor(job.make_env())])

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # The gradient steps of the last rollout are complete by now, which they are not in `_on_step`.
        while self._due and self.num_timesteps >= self._due[0]:
            self._evaluate(self._due.pop(0))

    def _on_training_end(self) -> None:
        for step in self._due:
            self._evaluate(step)

    def _evaluate(self, step: int) -> None:
        self._env.seed(EVALUATION_SEED)
        began = time.monotonic()
        mean, _ = evaluate_policy(self.model, self._env, self._episodes)
        mistakes, others = self.model.knowledge.seen  # type: ignore[attr-defined]
        row = {"step": step, "return": float(cast(float, mean)), "mistakes": mistakes / max(1, mistakes + others)}
        self._report({**row, "took": time.monotonic() - began})


def policy_for(env: gym.Env[Any, Any], algo: str) -> str:
    """SB3's policy for the observations of an environment."""
    memory = "Lstm" if algo == "ppo_lstm_ap" else ""
    if isinstance(env.observation_space, spaces.Dict):
        return f"MultiInput{memory}Policy"
    return f"Cnn{memory}Policy" if is_image_space(env.observation_space) else f"Mlp{memory}Policy"


def train(job: Job, report: Callable[[dict[str, Any]], None]) -> None:
    """Trains one run on the CPU with one thread."""
    env = job.make_env()
    model = GUIDED_ALGORITHMS[job.algo](policy_for(env, job.algo), env, seed=job.seed, device="cpu", **job.settings)
    model.learn(job.steps, callback=Evaluations(job, report))


def run_in_process(job: Job) -> Iterator[dict[str, Any]]:
    """Yields the evaluations of a run as they are made, or ``{"error": sentence}`` at the end."""
    paths = os.pathsep.join([path for path in sys.path if path])  # the user's modules may be anywhere
    process = subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | SINGLE_THREADED | {"PYTHONPATH": paths},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    _running.add(process)
    errors: list[bytes] = []
    reader = threading.Thread(target=lambda stream: errors.extend(stream), args=(process.stderr,), daemon=True)
    reader.start()
    finished = False
    try:
        cloudpickle.dump(job, process.stdin)
        process.stdin.close()
        for line in process.stdout:
            answer: dict[str, Any] = json.loads(line)
            finished = "seconds" in answer or "error" in answer
            yield answer
        code = process.wait()
    finally:
        process.kill()
        _running.discard(process)
    reader.join()
    if not finished:
        last = errors[-1].decode(errors="replace").strip() if errors else "it said nothing"
        yield {"error": f"its process ended with exit code {code}: {last}"}


def stop_all() -> None:
    """Kills the child processes of all runs in progress."""
    for process in list(_running):
        process.kill()


def main() -> None:
    """Entry point of the child process: a pickled :class:`Job` on standard input, JSON lines on standard output."""
    # The answers get a descriptor of their own, because libraries may print to standard output.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    began = time.monotonic()

    def report(row: dict[str, Any]) -> None:
        answers.write(json.dumps(row) + "\n")

    th.set_num_threads(1)
    try:
        job: Job = cloudpickle.load(sys.stdin.buffer)
        train(job, report)
    except Exception as error:
        report({"error": f"{type(error).__name__}: {' '.join(str(error).split())}"})
        return
    report({"seconds": time.monotonic() - began})


if __name__ == "__main__":
    main()
