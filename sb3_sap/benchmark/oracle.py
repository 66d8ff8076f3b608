"""What an AP function gives without learning: a random permissible action at every step, found by trying each out.

The environment is copied, an action is taken in the copy, and the AP function says what it was. That is Algorithm 1
with a predictor that never errs, and nothing else. It asks for a model of the environment, which a user seldom has; a
learner that does no better has learned no more than its AP function says.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_sap.benchmark.tasks import Episode
from sb3_sap.evaluation import make_env
from sb3_sap.permissibility import APFunction, ask, resolve

#: Actions of a box that are tried before the last one is taken, permissible or not.
TRIES = 32


def random_permissible(env_id: str, name: str, options: dict[str, Any], seeds: list[str], seed: int) -> list[list[Any]]:
    """Drives an episode of each seed; rows that follow the checkpoint in ``RETURN_COLUMNS``.

    :param name: dotted name of the AP function
    :param options: of the environment
    :param seed: of the draws
    """
    ap_function: APFunction = resolve(name, "ap_function")
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
    for action in _in_random_order(env.action_space, rng):  # the last one stays, permissible or not
        next_obs = copy.deepcopy(env).step(action)[0]
        if ask(ap_function, "ap_function", _one(obs), np.asarray(action)[None], _one(next_obs))[0]:
            break
    return action


def _in_random_order(space: spaces.Space[Any], rng: np.random.Generator) -> Iterator[Any]:
    if isinstance(space, spaces.Discrete):
        yield from rng.permutation(int(space.n))
    else:
        assert isinstance(space, spaces.Box)
        for _ in range(TRIES):
            yield rng.uniform(space.low, space.high).astype(np.float32)


def _one(obs: Any) -> Any:
    return {key: value[None] for key, value in obs.items()} if isinstance(obs, dict) else obs[None]
