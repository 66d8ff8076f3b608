"""Tasks beyond lane keeping: cells whose "simulator" is the id of a Gymnasium environment of ``zoo_configs``.

The "tracks" of such a cell are the seeds of its evaluation episodes, the score of an episode is its return.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.errors import nearest
from sb3_sap.evaluation import make_env
from sb3_sap.permissibility import APFunction, ask, resolve
from sb3_sap.presets import algorithms, load_config, settings_in

#: Seeds of the evaluation episodes, the same for every run.
EPISODES = tuple(map(str, range(10_000, 10_010)))
#: Evaluations of a training, evenly spread.
TIMES = 20
#: A peer's tuned settings get as many times our steps, at most, and so many seeds.
LONGER, FEWER = 10, 3
RETURN_COLUMNS = ["checkpoint", "track", "success", "permissible", "total_reward", "score", "steps"]


def guided_algorithms(env_id: str) -> list[str]:
    """The guided algorithms that have an entry for an environment."""
    guided = [algo for algo in ALGORITHMS if "_ap" in algo]
    found = [algo for algo in guided if env_id in load_config(algo)]
    if not found:
        known = {name for algo in guided for name in load_config(algo) if "-v" in name}
        raise ValueError(f"No guided algorithm has settings for {env_id!r} in zoo_configs: {nearest(env_id, known)}")
    return found


def entry(algo: str, env_id: str) -> dict[str, Any]:
    """The entry of an algorithm, or of the guided one that builds on it: it names the options of the environment."""
    guided = guided_algorithms(env_id)
    base = algo.partition("_ap")[0]
    own = next((name for name in guided if name == algo or name.partition("_ap")[0] == base), guided[0])
    return load_config(own)[env_id]


def task_columns(env_id: str) -> list[str]:
    """Each guided algorithm with an entry, its base at equal settings, RL Zoo's tuned entry where there is one; and
    the AP function by itself, unless it is the environment that labels.
    """
    columns = []
    for algo in guided_algorithms(env_id):
        base = algo.partition("_ap")[0]
        columns += [f"{algo}:task", f"{base}:task"]
        tuned = load_config(base).get(env_id) if base in algorithms() else None
        if tuned:
            steps = min(int(tuned["n_timesteps"]), LONGER * planned_steps(env_id))
            columns.append(f"{base}:tuned[steps={steps},seeds={FEWER}]")
    return columns + (["rule"] if "ap_function" in entry("rule", env_id) else [])


def planned_steps(env_id: str) -> int:
    """Training steps of the first guided entry."""
    return int(entry(guided_algorithms(env_id)[0], env_id)["n_timesteps"])


def task_settings(algo: str, preset: str, env_id: str, known: set[str]) -> dict[str, Any]:
    """Constructor arguments of a column.

    :param preset: "default", the library's own; "task", the guided entry, of which an unguided base takes what it
        knows; "tuned", the plain algorithm's entry, RL Zoo's
    :param known: parameters of the constructor
    """
    if preset == "default":
        return {}
    if preset == "task":
        settings = settings_in(entry(algo, env_id))
        return settings if "_ap" in algo else {key: value for key, value in settings.items() if key in known}
    tuned = load_config(algo).get(env_id) if "_ap" not in algo and algo in algorithms() else None
    if preset != "tuned" or tuned is None:
        raise ValueError(
            f"{algo} has no preset {preset!r} for {env_id}: choose 'default', 'task', or a base's 'tuned'."
        )
    return settings_in(tuned)


def evaluations(steps: int) -> list[int]:
    """Training steps after which the actor is evaluated."""
    return sorted({*range(steps // TIMES, steps, max(1, steps // TIMES)), steps} - {0})


def evaluation(env_id: str, algo: str, options: dict[str, Any], seeds: list[str]) -> Callable[[Any], list[list[Any]]]:
    """A function that evaluates a policy deterministically: rows that follow the checkpoint in ``RETURN_COLUMNS``."""
    name = entry(algo, env_id).get("ap_function")
    ap_function = None if name is None else resolve(name, "ap_function")
    envs = [make_env(env_id, **options) for _ in seeds]

    def evaluate(policy: Any) -> list[list[Any]]:
        episodes = [Episode(env, int(seed)) for env, seed in zip(envs, seeds, strict=True)]
        # Side by side: to ask a small network once for all costs as much as for one.
        while running := [episode for episode in episodes if not episode.done]:
            actions, _ = policy.predict(_stacked([episode.obs for episode in running]), deterministic=True)
            for episode, action in zip(running, actions, strict=True):
                episode.step(action)
        return [[seed, *episode.row(ap_function)] for seed, episode in zip(seeds, episodes, strict=True)]

    return evaluate


class Episode:
    """An episode that runs, and what is told of it when it has ended.

    :param env: the environment, which is reset
    :param seed: of this episode
    """

    def __init__(self, env: gym.Env[Any, Any], seed: int):
        self.env = env
        self.obs = copy.deepcopy(env.reset(seed=seed)[0])
        self.done = False
        self._total = 0.0
        self._info: dict[str, Any] = {}
        self._observations = [self.obs]
        self._actions: list[Any] = []
        self._labels: list[bool | None] = []

    def step(self, action: Any) -> None:
        """Goes on by one step."""
        obs, reward, terminated, truncated, self._info = self.env.step(action)
        self.obs = copy.deepcopy(obs)  # an environment may reuse its array
        self.done = terminated or truncated
        self._total += float(reward)
        self._observations.append(self.obs)
        self._actions.append(action)
        self._labels.append(self._info.get("permissible"))

    def row(self, ap_function: APFunction | None) -> list[Any]:
        """Success, if the environment tells; share of permissible actions; return, twice; steps.

        :param ap_function: labels the actions; None: the environment did
        """
        labels: Any = self._labels
        if ap_function is not None:
            before, after = _stacked(self._observations[:-1]), _stacked(self._observations[1:])
            labels = ask(ap_function, "ap_function", before, np.stack(self._actions), after)
        success, total = self._info.get("is_success"), round(self._total, 4)
        permissible = round(float(np.mean(labels)), 4)
        return [None if success is None else bool(success), permissible, total, total, len(labels)]


def _stacked(observations: list[Any]) -> Any:
    first = observations[0]
    if isinstance(first, dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in first}
    return np.stack(observations)
