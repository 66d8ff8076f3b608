"""The configurations that each report of a task beyond lane keeping compares."""

from __future__ import annotations

from collections.abc import Callable

from sb3_sap.algorithms import base_of
from sb3_sap.benchmark.task_settings import guided_algorithms, has_oracle, planned_steps
from sb3_sap.presets import algorithms, load_config, preset_names

#: Baselines with RL Zoo's tuned settings train for at most this many times the steps of the guided algorithm.
LONGER = 10
#: Number of seeds of such a baseline.
FEWER = 3
#: The constant reward penalty that did best in a screening on design seeds.
TUNED_PENALTIES = {"MountainCarContinuous-v0": 0.25, "Pendulum-v1": 0.5, "MountainCar-v0": 1.0, "Acrobot-v1": 1.0}
#: AP functions of the whole action, of tasks whose entry has labels for parts of it.
WHOLE_ACTION = {
    "FetchReach-v4": "sb3_sap.tasks.fetch_reach",
    "sap/TorcsRacing-v0": "sb3_sap.tasks.racing_whole",
}


def task_configurations(env_id: str) -> list[str]:
    """The configurations that are compared on a task.

    They are each guided algorithm with an entry, its base with the same settings, its base with RL Zoo's tuned settings
    if there are any, and the look-ahead oracle where it can act.
    """
    configurations = []
    for algo in guided_algorithms(env_id):
        base = base_of(algo)
        configurations += [f"{algo}:task", f"{base}:task"]
        tuned = load_config(base).get(env_id) if base in algorithms() else None
        if tuned:
            steps = min(int(tuned["n_timesteps"]), LONGER * planned_steps(env_id))
            configurations.append(f"{base}:tuned[steps={steps},seeds={FEWER}]")
    return configurations + (["oracle"] if has_oracle(env_id) else [])


def ways_of(env_id: str) -> list[str]:
    """The ways of using the label with the first guided algorithm that has an entry, and the entry itself."""
    algo = guided_algorithms(env_id)[0]
    tuned = TUNED_PENALTIES.get(env_id)
    return [
        f"{algo}:base+penalty[penalty=0]",
        *([] if tuned is None else [f"{algo}:base+penalty[penalty={tuned:g}]"]),
        f"{algo}:base+penalty",
        *([f"{algo}:base+loss"] if "loss" in preset_names(algo) else []),
        f"{algo}:task",
    ]


def parts_of(env_id: str) -> list[str]:
    """The ways of using the label, with a label for each part of the action and with one for the whole.

    :raise ValueError: if there are no labels for parts, or no label of the whole action
    """
    if env_id not in WHOLE_ACTION:
        raise ValueError(
            f"The report 'parts' needs an AP function for parts of the action and one for the whole, which "
            f"{env_id} does not have: choose from {', '.join(WHOLE_ACTION)}."
        )
    ways = ways_of(env_id)
    return [*ways, *(with_one_label(way, env_id) for way in ways if "[" not in way)]


def with_one_label(configuration: str, env_id: str) -> str:
    """A configuration with one label for the whole action."""
    return f"{configuration}[ap_function={WHOLE_ACTION[env_id]},action_parts=null]"


def races_of(env_id: str) -> list[str]:
    """The ways of using the label in racing, the entry with one label, and the driver that is written down."""
    ways = ways_of(env_id)
    return [*ways, with_one_label(ways[-1], env_id), "scripted"]


def starts_of(env_id: str) -> list[str]:
    """What a run may begin with, from a log of `sb3_sap.benchmark.logs`."""
    algo = f"{guided_algorithms(env_id)[0]}_started"
    return [
        f"{algo}:base+penalty[start=nothing]",
        f"{algo}:base+loss[start=nothing]",
        f"{algo}:base+penalty[start=guided,source=log]",
        f"{algo}:base+penalty[start=replay,source=log]",
        *(
            f"{algo}:base+{presets}[start={start},source={source}]"
            for source in ("log", "random")
            for presets, start in (("penalty", "cloned"), ("loss", "imitated"))
        ),
    ]


#: The configurations of each report.
COMPARED: dict[str, Callable[[str], list[str]]] = {
    "returns": task_configurations,
    "ways": ways_of,
    "starts": starts_of,
    "parts": parts_of,
    "races": races_of,
}
