"""Logs of simple controllers and of random actions, for the comparison of starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sb3_sap.benchmark.linear import GAINS, LinearFeedback
from sb3_sap.common.arrays import copy_observation, rows_of, stack_observations
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.tasks.reach import NEAR
from sb3_sap.transitions.batch import Transitions

#: Steps of a log.
LOG_STEPS = 20_000
#: Standard deviation of the noise of a controller, whose actions are from -1 to 1.
NOISE = 0.3


def along_the_motion(obs: Any) -> Any:
    """``MountainCarContinuous-v0``: the whole push the way the car moves."""
    return np.where(obs[1:] < 0, -1.0, 1.0)


def towards_the_goal(obs: Any) -> Any:
    """``FetchReach-v4``: the hand straight to the goal, slower within 5 cm, and the gripper at rest."""
    return np.append((obs["desired_goal"] - obs["achieved_goal"]) / NEAR, 0.0)


def linear(driver: LinearFeedback, obs: Any) -> Any:
    """Lane keeping: linear feedback."""
    return driver.predict(obs)[0]


#: The controller of a simulator of lane keeping, or of a task, a function of one observation.
CONTROLLERS: dict[str, Callable[[Any], Any]] = {
    "MountainCarContinuous-v0": along_the_motion,
    "FetchReach-v4": towards_the_goal,
    **{simulator: partial(linear, LinearFeedback(**gains)) for simulator, gains in GAINS.items()},
}


def guide(simulator: str) -> Callable[[Any], Any]:
    """The controller of a simulator or a task, for a batch of observations."""
    return partial(_of_batch, CONTROLLERS[simulator])


def _of_batch(controller: Callable[[Any], Any], obs: Any) -> Any:
    n = len(next(iter(obs.values())) if isinstance(obs, dict) else obs)
    return np.stack([controller(rows_of(obs, row)) for row in range(n)])


def log(kind: str, simulator: str, seed: int) -> Transitions:
    """What a controller with noise, or random actions, did.

    :param kind: "log"; "wrong", the same with one label in ten wrong; "region", the same without steps left of the
        centre line; or "random"
    :param simulator: of lane keeping, or the id of a task
    :return: with the labels of the environment, if it has any
    """
    options = {"track": "wheel-2", "laps": None} if simulator in ENVIRONMENTS else {}
    env = make_env(ENVIRONMENTS.get(simulator, simulator), **options)
    rng, space = np.random.default_rng([seed, 28]), env.action_space
    rows = []
    obs, _ = env.reset(seed=seed)
    for _ in range(LOG_STEPS):
        obs = copy_observation(obs)
        random = kind == "random"
        action = rng.uniform(-1, 1, space.shape) if random else CONTROLLERS[simulator](obs)
        action = np.clip(action + (0 if random else rng.normal(0, NOISE, space.shape)), -1, 1).astype(np.float32)
        next_obs, reward, terminated, truncated, info = env.step(action)
        ends = (reward, terminated or truncated, truncated and not terminated)
        rows.append((obs, action, copy_observation(next_obs), *ends, info.get("permissible")))
        obs = env.reset()[0] if terminated or truncated else next_obs
    env.close()
    obs_before, actions, obs_after, rewards, dones, cut_off, labels = zip(*rows, strict=True)
    made = Transitions(
        stack_observations(list(obs_before)),
        np.array(actions),
        stack_observations(list(obs_after)),
        np.array(rewards),
        np.array(dones),
        np.array(cut_off),
        None if labels[0] is None else np.array(labels),
    )
    if kind == "wrong":
        return replace(made, labels=np.logical_xor(np.array(labels), rng.random(len(made)) < 0.1))
    return made.rows(np.asarray(made.obs)[:, 1] <= 0) if kind == "region" else made
