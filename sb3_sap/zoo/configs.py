"""Checks of an algorithm's YAML file, with clear errors before anything is built from it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from rl_zoo3 import ALGOS
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sap.common.errors import nearest
from sb3_sap.common.functions import resolve
from sb3_sap.common.schedules import LINEAR
from sb3_sap.guidance.auxiliary_update import AuxiliaryLossMixin
from sb3_sap.presets import RUNNER_KEYS, algorithms

#: Types allowed by each word of a type annotation. The constructor checks what has other annotations.
KINDS: dict[str, tuple[type, ...]] = {
    "int": (int,),
    "float": (int, float),
    "bool": (bool,),
    "str": (str,),
    "None": (type(None),),
}
#: Keys whose values are dotted names of classes or functions.
DOTTED = ("env_wrapper", "vec_env_wrapper", "callback")
#: Keys whose values may be "lin_0.001": rl_zoo3 converts the first of them, the constructors all.
SCHEDULES = AuxiliaryLossMixin.schedules


def packaged(algo: str) -> str | None:
    """The path of this package's YAML file for an algorithm; ``None`` if there is none."""
    return str(resources.files("sb3_sap") / "zoo_configs" / f"{algo}.yml") if algo in algorithms() else None


def check_algo(algo: str) -> None:
    """Checks that rl_zoo3 knows an algorithm."""
    if algo not in ALGOS:
        raise ValueError(f"`--algo` {algo!r} is unknown: {nearest(algo, ALGOS)}")


def check_file(path: str) -> None:
    """Checks that a file maps environments to settings, and names this package's environments correctly."""
    file = Path(path)
    if file.suffix not in (".yml", ".yaml"):
        return  # Python, which checks itself
    if not file.is_file():
        raise FileNotFoundError(f"There is no configuration file {path}: give one with `-conf`.")
    try:
        entries = yaml.safe_load(file.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        where = f" in line {error.problem_mark.line + 1}" if getattr(error, "problem_mark", None) else ""
        raise ValueError(f"{path} is not YAML{where}: {getattr(error, 'problem', error)}.") from error
    if not isinstance(entries, Mapping):
        raise TypeError(f"{path} must hold environments with their settings, but holds a {type(entries).__name__}.")
    for name, entry in entries.items():
        if not isinstance(entry, Mapping):
            raise TypeError(f"{path}: the entry {name!r} must hold settings, `key: value`, but is {entry!r}.")
        if str(name).startswith("sap/") and name not in gym.registry:
            packaged_ids = [known for known in gym.registry if known.startswith("sap/")]
            raise ValueError(f"{path}: the environment {name!r} is unknown: {nearest(name, packaged_ids)}")


def evaluation_options(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the environment in evaluations: those of the entry, except ``laps``, which has its default."""
    return {name: value for name, value in hyperparams.get("env_kwargs", {}).items() if name != "laps"}


def check_hyperparameters(algo: str, hyperparams: Mapping[str, Any], source: str) -> None:
    """Checks that rl_zoo3 or the algorithm knows each key, and that each value has the right type."""
    algorithm: Any = ALGOS[algo]
    parameters = inspect.signature(algorithm).parameters
    known = (set(parameters) | RUNNER_KEYS) - {"env", "seed", "verbose", "device", "tensorboard_log", "self"}
    for key, value in hyperparams.items():
        if key not in known:
            raise ValueError(f"{source}: the key {key!r} is unknown to {algo}: {nearest(key, sorted(known))}")
        if key in parameters and key not in RUNNER_KEYS:
            _check_type(key, value, parameters[key], source)
        if key in DOTTED:
            _check_dotted(key, value)
    if "n_timesteps" in hyperparams:
        _check_kinds("n_timesteps", hyperparams["n_timesteps"], ["int", "float"], source)  # 1e6 is a float to YAML
    if hyperparams.get("normalize") and hyperparams.get("frame_stack", 1) != 1:
        _check_stacking(algo, algorithm, hyperparams["frame_stack"], source)
    policy = hyperparams.get("policy", "MlpPolicy")
    if isinstance(policy, str) and "." not in policy and policy not in algorithm.policy_aliases:
        raise ValueError(f"{source}: `policy` {policy!r} is unknown: {nearest(policy, algorithm.policy_aliases)}")


def _check_stacking(algo: str, algorithm: Any, frame_stack: Any, source: str) -> None:
    """Refuses frames stacked on top of VecNormalize: the replay buffer would hold its raw, unstacked observations."""
    if issubclass(algorithm, OffPolicyAlgorithm):
        raise ValueError(
            f"{source}: {algo} cannot have `normalize` and `frame_stack` together, for RL Zoo stacks what is "
            "normalised already: in place of `frame_stack` stack first, `vec_env_wrapper: [{"
            f"stable_baselines3.common.vec_env.VecFrameStack: {{n_stack: {frame_stack}}}}}]`."
        )


def _check_type(key: str, value: Any, parameter: inspect.Parameter, source: str) -> None:
    if key in SCHEDULES:
        if isinstance(value, str) and not re.fullmatch(LINEAR, value):
            raise TypeError(
                f'{source}: `{key}` must be a number or "lin_<number>", but is {value!r}.{_exponent_hint(value)}'
            )
        return
    annotation = parameter.annotation
    words = re.findall(r"\w+", annotation if isinstance(annotation, str) else _words_of(annotation))
    if words and all(word in KINDS for word in words):
        _check_kinds(key, value, words, source)


def _words_of(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


def _check_kinds(key: str, value: Any, kinds: list[str], source: str) -> None:
    if isinstance(value, bool) and "bool" not in kinds:
        good = False  # to Python a bool is an int
    else:
        good = isinstance(value, tuple(kind for name in kinds for kind in KINDS[name]))
    if not good:
        must = " or ".join(dict.fromkeys(kinds))
        raise TypeError(f"{source}: `{key}` must be {must}, but is {value!r}.{_exponent_hint(value)}")


def _exponent_hint(value: Any) -> str:
    """How to write a number such as 1e6, which YAML reads as text; empty for other values."""
    number = isinstance(value, str) and re.fullmatch(r"\d+e[+-]?\d+", value)
    return f" YAML reads {value} as text: write it with a point, {value.replace('e', '.0e')}." if number else ""


def _check_dotted(key: str, value: Any) -> None:
    for entry in value if isinstance(value, list) else [value]:
        name = next(iter(entry)) if isinstance(entry, Mapping) else entry
        if isinstance(name, str):
            resolve(name, key)
