"""Tasks beyond lane keeping: the settings of runs on an environment of ``zoo_configs``.

The "simulator" of such a run is the id of the environment, its "tracks" are the seeds of the evaluation episodes, and
the score of an episode is its return.
"""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium as gym
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sap.algorithms import ALGORITHMS, base_of, is_guided
from sb3_sap.common.errors import nearest
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.presets import algorithms, load_config, preset_names, settings_in
from sb3_sap.presets import preset as settings_of_preset

#: Seeds of the evaluation episodes, the same in every run.
EPISODES = tuple(map(str, range(10_000, 10_010)))
#: Number of evaluations of a training, at equal distances.
EVALUATIONS = 20
#: Mean returns that count as a task's goal where the environment names none, or one that takes long to reach.
GOALS = {
    "Pendulum-v1": -200.0,
    "Acrobot-v1": -100.0,
    "MountainCarContinuous-v0": 90.0,
    "MountainCar-v0": -110.0,
    "FetchReach-v4": -3.0,
    "highway-fast-v0": 54.0,  # about the look-ahead oracle's
    "racetrack-v0": 100.0,
    "sap/MiniGrid-v0": 0.9,
}
#: Presets that are not for lane keeping alone.
ANY_TASK = ("penalty", "loss")
#: Settings of guided algorithms that say how labels are used, and not what they are.
GUIDANCE = (
    set(inspect.signature(ActionPermissibilityMixin).parameters) - set(inspect.signature(OffPolicyAlgorithm).parameters)
    | {"predictor_epochs"}
) - {
    "ap_function",
    "action_parts",
    "event",
    "horizon",
    "risk_discount",
    "risk_threshold",
    "potential",
    "constraint",
    "permissible_actions",
    "actor_learning_rate",
}


def guided_algorithms(env_id: str) -> list[str]:
    """The guided algorithms that have settings for an environment.

    :raise ValueError: if there is none
    """
    guided = [algo for algo in (*ALGORITHMS, *ON_POLICY_ALGORITHMS) if is_guided(algo) and algo in algorithms()]
    found = [algo for algo in guided if env_id in load_config(algo)]
    if not found:
        known = {name for algo in guided for name in load_config(algo) if "-v" in name}
        raise ValueError(f"No guided algorithm has settings for {env_id!r} in zoo_configs: {nearest(env_id, known)}")
    return found


def entry(algo: str, env_id: str) -> dict[str, Any]:
    """The entry of an algorithm in ``zoo_configs``, or else of the guided algorithm that builds on it."""
    guided = guided_algorithms(env_id)
    own = next((name for name in guided if name == algo or base_of(name) == base_of(algo)), guided[0])
    return load_config(own)[env_id]


def has_oracle(env_id: str) -> bool:
    """Whether the look-ahead oracle can act: there is an AP function, and the environment can be copied, which TORCS
    cannot.
    """
    return "ap_function" in entry("oracle", env_id) and "Torcs" not in env_id


def planned_steps(env_id: str) -> int:
    """Training steps of the first guided algorithm with an entry."""
    return int(entry(guided_algorithms(env_id)[0], env_id)["n_timesteps"])


def task_settings(algo: str, preset: str, env_id: str, known: set[str]) -> dict[str, Any]:
    """Constructor arguments for a task.

    :param preset: "default", the library's defaults; "task", the entry of the guided algorithm, without what an
        unguided base does not know; "base", the same for a guided algorithm, with the label but without guidance;
        "tuned", RL Zoo's settings of the base; or one of `ANY_TASK`
    :param known: parameters of the constructor
    :raise ValueError: if the algorithm has no such preset for the environment
    """
    if preset == "default":
        return {}
    if preset == "task":
        settings = settings_in(entry(algo, env_id))
        return settings if is_guided(algo) else {key: value for key, value in settings.items() if key in known}
    if preset == "base" and is_guided(algo):
        return {key: value for key, value in settings_in(entry(algo, env_id)).items() if key not in GUIDANCE}
    if preset in ANY_TASK and preset in preset_names(algo):
        return settings_of_preset(preset, algo)
    tuned = load_config(algo).get(env_id) if not is_guided(algo) and algo in algorithms() else None
    if preset != "tuned" or tuned is None:
        raise ValueError(
            f"{algo} has no preset {preset!r} for {env_id}: choose 'default', 'task', or 'tuned' for a base."
        )
    return settings_in(tuned)


def evaluations(steps: int) -> list[int]:
    """Training steps after which the actor is evaluated."""
    return sorted({*range(steps // EVALUATIONS, steps, max(1, steps // EVALUATIONS)), steps} - {0})


def target_return(env_id: str) -> float:
    """The mean return from which a task counts as learned.

    :raise ValueError: if neither `GOALS` nor the environment names one
    """
    if env_id in GOALS:
        return GOALS[env_id]
    threshold = gym.spec(env_id).reward_threshold
    if threshold is None:
        raise ValueError(f"{env_id} names no return from which it is solved: add it to `GOALS`.")
    return float(threshold)
