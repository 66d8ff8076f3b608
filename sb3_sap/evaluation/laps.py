"""Laps with the policy alone, without noise and without guidance (Table 2)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from sb3_sap.common.acting import Actor
from sb3_sap.common.files import atomic_path
from sb3_sap.envs import score

if TYPE_CHECKING:
    from rich.progress import Progress

#: The lane-keeping task on each simulator.
ENVIRONMENTS = {"highway": "sap/LaneKeeping-v0", "torcs": "sap/TorcsLaneKeeping-v0"}


@dataclass(frozen=True)
class LapResult:
    """One lap, or the part of it that was driven."""

    track: str
    lap_done: bool
    covered: float  # fraction of the lap
    total_reward: float
    score: float  # normalised: 1 is a perfect lap
    steps: int


def drive(policy: Any, env: gym.Env[Any, Any]) -> Iterator[tuple[float, dict[str, Any]]]:
    """Drives one episode deterministically.

    :param policy: a model or policy with SB3's ``predict``
    :return: (reward, info) of each step
    """
    act = Actor(policy)
    obs, _ = env.reset(seed=0)
    done = False
    while not done:
        obs, reward, terminated, truncated, info = env.step(act(obs))
        done = terminated or truncated
        yield float(reward), info


def lap_env(track: str, simulator: str = "highway", **options: Any) -> gym.Env[Any, Any]:
    """Makes the environment of one lap; it may be driven any number of times."""
    return gym.make(ENVIRONMENTS[simulator], track=track, laps=1, **options)


def lap(
    policy: Any, env: gym.Env[Any, Any], track: str, on_step: Callable[[dict[str, Any]], object] | None = None
) -> LapResult:
    """Drives one lap in an environment of :func:`lap_env`.

    Tracks are driven one after the other: most of the time is physics, so that a batched policy would save only a
    tenth of it, and the last bit of its actions would change.

    :param track: its name in the result
    :param on_step: called with the info of each step
    """
    rewards = []
    info: dict[str, Any] = {}
    for reward, info in drive(policy, env):
        rewards.append(reward)
        if on_step:
            on_step(info)
    driven = env.unwrapped.simulator  # type: ignore[attr-defined]
    total = sum(rewards)
    normalised = score(total, driven.length, driven.control_step)
    return LapResult(track, bool(info["lap_done"]), float(info["covered"]), total, normalised, len(rewards))


def drive_lap(policy: Any, track: str, simulator: str = "highway", progress: Progress | None = None) -> LapResult:
    """Drives one lap of a track in an environment of its own.

    :param policy: a model or policy with SB3's ``predict``
    :param track: its name or file
    :param simulator: a key of `ENVIRONMENTS`
    :param progress: shows a bar, if given
    """
    env = lap_env(track, simulator)
    try:
        if progress is None:
            return lap(policy, env, track)
        task = progress.add_task(f"lap of {track}", total=1.0)
        return lap(policy, env, track, lambda info: progress.update(task, completed=info["covered"]))
    finally:
        env.close()


def write_results(path: Path, results: list[LapResult]) -> None:
    """Writes ``evaluation.json``: a list of the results."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps([asdict(result) for result in results], indent=2) + "\n", encoding="utf-8")
