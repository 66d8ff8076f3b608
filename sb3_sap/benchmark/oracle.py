"""The look-ahead oracle: random permissible actions, each found by trying actions in a copy of the environment.

It is Algorithm 1 with a predictor that never errs and without learning, and shows what an AP function gives by itself.
It needs a model of the environment, which users seldom have. A learner that does no better has learned no more than its
AP function contains.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_sap.benchmark.episodes import Episode, of_whole_action
from sb3_sap.evaluation.environments import make_env
from sb3_sap.permissibility import APFunction, query_labels

#: Actions of a box that are tried; if none is permissible, the last one is executed.
TRIES = 32


def oracle_episodes(env_id: str, name: str, options: dict[str, Any], seeds: list[str], seed: int) -> list[list[Any]]:
    """Lets the oracle act for one episode of each seed.

    :param name: dotted name of the AP function
    :param options: of the environment
    :param seed: of the random actions
    :return: rows of ``RETURN_COLUMNS`` without the checkpoint
    """
    ap_function = of_whole_action(name)
    rng = np.random.default_rng(seed)
    rows = []
    for number in seeds:
        env = make_env(env_id, **options)
        episode = Episode(env, int(number))
        while not episode.done:
            episode.step(_choose(env, episode.obs, ap_function, rng))
        rows.append([number, *episode.row(ap_function)])
    return rows


def _choose(env: Any, obs: Any, ap_function: APFunction, rng: np.random.Generator) -> Any:
    for action in _in_random_order(env.action_space, rng):
        next_obs = copy.deepcopy(env).step(action)[0]
        if query_labels(ap_function, "ap_function", _batch(obs), np.asarray(action)[None], _batch(next_obs))[0]:
            break
    return action


def _in_random_order(space: spaces.Space[Any], rng: np.random.Generator) -> Iterator[Any]:
    if isinstance(space, spaces.Discrete):
        yield from rng.permutation(int(space.n))
    else:
        assert isinstance(space, spaces.Box)
        for _ in range(TRIES):
            yield rng.uniform(space.low, space.high).astype(np.float32)


def _batch(obs: Any) -> Any:
    return {key: value[None] for key, value in obs.items()} if isinstance(obs, dict) else obs[None]
