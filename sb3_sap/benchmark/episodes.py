"""Evaluation beyond lane keeping: returns and shares of permissible actions over episodes of the policy alone."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_sap.benchmark.task_settings import entry
from sb3_sap.common.acting import Actor
from sb3_sap.common.functions import resolve
from sb3_sap.evaluation.environments import make_env
from sb3_sap.permissibility import APFunction, query_labels

RETURN_COLUMNS = ["checkpoint", "track", "success", "permissible", "total_reward", "score", "steps"]


def evaluation(
    env_id: str, algo: str, options: dict[str, Any], seeds: list[str]
) -> Callable[[Any, int], list[list[Any]]]:
    """A function that evaluates a policy deterministically.

    :param options: of the environment
    :param seeds: one for each episode
    :return: a function of a policy and a checkpoint, which returns rows of ``RETURN_COLUMNS`` without the checkpoint
    """
    name = entry(algo, env_id).get("ap_function")
    ap_function = None if name is None else of_whole_action(name)
    envs = [make_env(env_id, **options) for _ in seeds]

    def evaluate(policy: Any, checkpoint: int = 0) -> list[list[Any]]:
        del checkpoint  # all are alike
        episodes = [Episode(env, int(seed)) for env, seed in zip(envs, seeds, strict=True)]
        # The episodes run side by side, because a small network takes as long for one observation as for all.
        act, running = Actor(policy), episodes
        while running:
            actions = act(_stacked([episode.obs for episode in running]))
            for episode, action in zip(running, actions, strict=True):
                episode.step(action)
            act.keep(np.array([not episode.done for episode in running]))
            running = [episode for episode in running if not episode.done]
        return [[seed, *episode.row(ap_function)] for seed, episode in zip(seeds, episodes, strict=True)]

    return evaluate


def of_whole_action(name: str) -> APFunction:
    """The AP function of a dotted name, as one label for each action where it has labels of parts."""
    ap_function: APFunction = resolve(name, "ap_function")

    @functools.wraps(ap_function)
    def whole(obs: Any, actions: Any, next_obs: Any) -> Any:
        labels = np.asarray(ap_function(obs, actions, next_obs))
        return labels.all(axis=1) if labels.ndim > 1 else labels

    return whole


class Episode:
    """One episode of an environment, and its statistics once it has ended.

    :param env: environment, which is reset
    :param seed: seed of the reset
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
        """Executes one action."""
        obs, reward, terminated, truncated, self._info = self.env.step(action)
        self.obs = copy.deepcopy(obs)  # an environment may reuse its array
        self.done = terminated or truncated
        self._total += float(reward)
        self._observations.append(self.obs)
        self._actions.append(action)
        self._labels.append(self._info.get("permissible"))

    def row(self, ap_function: APFunction | None) -> list[Any]:
        """Success if the environment reports it, share of permissible actions, return, return as score, steps.

        :param ap_function: labels the actions; None if the environment has labelled them
        """
        labels: Any = self._labels
        if ap_function is not None:
            before, after = _stacked(self._observations[:-1]), _stacked(self._observations[1:])
            labels = query_labels(ap_function, "ap_function", before, np.stack(self._actions), after)
        success, total = self._info.get("is_success"), round(self._total, 4)
        permissible = round(float(np.mean(labels)), 4)
        return [None if success is None else bool(success), permissible, total, total, len(labels)]


def _stacked(observations: list[Any]) -> Any:
    first = observations[0]
    if isinstance(first, dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in first}
    return np.stack(observations)
