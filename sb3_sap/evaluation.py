"""Driving laps with a policy alone: what was learned, without noise and without guidance (Table 2)."""

from __future__ import annotations

import importlib
import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_sap.envs import score
from sb3_sap.files import atomic_path
from sb3_sap.normalisation import NormalisedPolicy, with_statistics

if TYPE_CHECKING:
    from rich.progress import Progress

#: The lane-keeping task on each simulator.
ENVIRONMENTS = {"highway": "sap/LaneKeeping-v0", "torcs": "sap/TorcsLaneKeeping-v0"}


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """``gym.make``, which finds highway-env's tasks as well."""
    find_environment(env_id)
    return gym.make(env_id, **options)


def find_environment(env_id: str) -> None:
    """Has highway-env register its tasks, which it does when it is imported, if the environment is not known yet."""
    if env_id not in gym.registry:
        importlib.import_module("highway_env")


@dataclass(frozen=True)
class LapResult:
    """One lap, or what was driven of it."""

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
    obs, _ = env.reset(seed=0)
    done = False
    while not done:
        action, _ = policy.predict(obs, deterministic=True)
        obs, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        yield float(reward), info


def lap_env(track: str, simulator: str = "highway", **options: Any) -> gym.Env[Any, Any]:
    """Makes the environment of one lap; it may be driven any number of times."""
    return gym.make(ENVIRONMENTS[simulator], track=track, laps=1, **options)


def lap(
    policy: Any, env: gym.Env[Any, Any], track: str, on_step: Callable[[dict[str, Any]], object] | None = None
) -> LapResult:
    """Drives one lap in an environment of :func:`lap_env`.

    Several tracks are driven one after the other on purpose. Asking the policy for all of them at once would save a
    tenth of the time, most of which is physics, and would change the last bit of its actions.

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
    """Drives one lap of a track."""
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


def load_policy(path: str | Path, vecnormalize: str | Path | None = None) -> BasePolicy | NormalisedPolicy:
    """Loads the policy alone from a model file, whichever SB3 algorithm saved it; it takes raw observations.

    :param vecnormalize: statistics of SB3's ``VecNormalize``; without them those that lie beside the model, as RL Zoo
        and SB3's ``CheckpointCallback`` leave them, if it learned on normalised observations or does not say
    """
    path, vecnormalize = Path(path), None if vecnormalize is None else Path(vecnormalize)
    if not path.is_file():
        raise FileNotFoundError(f"There is no model file {path}: give the .zip that `model.save` or the demo wrote.")
    try:
        data, params, _ = load_from_zip_file(path, device="cpu")
    except (ValueError, EOFError, zipfile.BadZipFile, RuntimeError, KeyError) as error:
        raise ValueError(f"{path} is not a whole model file ({error}): save the model again.") from error
    if data is None or params is None or "policy" not in params:
        raise ValueError(f"{path} holds no SB3 policy: give a file that `model.save` wrote.")
    policy: BasePolicy = data["policy_class"](
        data["observation_space"], data["action_space"], lambda _: 0.0, **data["policy_kwargs"]
    )
    policy.load_state_dict(cast(dict[str, Any], params["policy"]))
    policy.set_training_mode(False)
    return with_statistics(policy, path, data.get("learned_normalised"), vecnormalize)
