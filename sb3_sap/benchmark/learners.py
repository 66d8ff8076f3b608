"""From a configuration to a model: the class of its algorithm, and its settings."""

from __future__ import annotations

import copy
import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_sap.algorithms import ALGORITHMS, base_of
from sb3_sap.benchmark.configurations import CONTROLLERS, Configuration, unknown_algorithm
from sb3_sap.benchmark.linear import GAINS
from sb3_sap.benchmark.task_settings import entry, has_oracle, task_settings
from sb3_sap.common.action_noise import make_action_noise
from sb3_sap.common.extractors import with_extractor
from sb3_sap.common.functions import resolve
from sb3_sap.common.schedules import as_schedule
from sb3_sap.common.settings import SettingsMixin
from sb3_sap.envs.torcs.scripted import DECELERATION
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.evaluation.racing import RACING
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.onpolicy.mixin import OnPolicyPermissibilityMixin
from sb3_sap.presets import preset

#: The class of each algorithm, which is imported only when it is needed.
CLASSES = {algo: f"sb3_sap:{cls.__name__}" for algo, cls in (ALGORITHMS | ON_POLICY_ALGORITHMS).items()} | {
    "ppo": "stable_baselines3:PPO",
    "a2c": "stable_baselines3:A2C",
    "trpo": "sb3_contrib:TRPO",
    "ppo_lstm": "sb3_contrib:RecurrentPPO",
    "dqn": "stable_baselines3:DQN",
    "qrdqn": "sb3_contrib:QRDQN",
    "ddpg_ap_unbalanced": "sb3_sap.benchmark.ablated:DDPGAPUnbalanced",
    "ddpg_ap_proposed": "sb3_sap.benchmark.ablated:DDPGAPProposed",
    "sac_recovery": "sb3_sap.benchmark.recovery:SACRecovery",
    "ddpg_ap_started": "sb3_sap.benchmark.started:DDPGAPStarted",
    "sac_ap_started": "sb3_sap.benchmark.started:SACAPStarted",
    "td3": "stable_baselines3:TD3",
    "sac": "stable_baselines3:SAC",
    "tqc": "sb3_contrib:TQC",
    "crossq": "sb3_contrib:CrossQ",
    "sbx_ddpg": "sbx:DDPG",
    "sbx_td3": "sbx:TD3",
    "sbx_sac": "sbx:SAC",
    "sbx_tqc": "sbx:TQC",
    "sbx_crossq": "sbx:CrossQ",
}
#: Algorithms that use the settings of another one.
NAMESAKES = {algo: algo.removeprefix("sbx_") for algo in CLASSES if algo.startswith("sbx_")} | {
    "ddpg_ap_unbalanced": "ddpg_ap",
    "ddpg_ap_proposed": "ddpg_ap",
    "sac_recovery": "sac_ap",
    "ddpg_ap_started": "ddpg_ap",
    "sac_ap_started": "sac_ap",
}
#: Prefix of overrides that change the environment instead of the algorithm.
ENVIRONMENT = "env."


def plain_name(algo: str) -> str:
    """The name of the algorithm whose settings a variant or another library's algorithm uses; else the name itself."""
    return NAMESAKES.get(algo, algo)


def algorithm_class(algo: str) -> type[BaseAlgorithm]:
    """The class of an algorithm.

    :raise ValueError: if there is no such algorithm, or if it needs SBX, which is not installed
    """
    if algo not in CLASSES:
        raise unknown_algorithm(algo, [*CLASSES, *CONTROLLERS])
    module, _, name = CLASSES[algo].partition(":")
    try:
        found: type[BaseAlgorithm] = getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if module != "sbx":
            raise
        raise ValueError(f"{algo} needs SBX, and {error.name} is missing: pip install 'sb3-sap[sbx]'.") from error
    return found


def is_on_policy(cls: type[BaseAlgorithm]) -> bool:
    """Whether an algorithm learns from rollouts."""
    return issubclass(cls, OnPolicyAlgorithm)


def settings_of(configuration: Configuration, simulator: str, steps: int) -> dict[str, Any]:
    """Constructor arguments: the settings of the preset, with the overrides of the configuration.

    :raise ValueError: if the algorithm has no such preset or setting
    """
    if not configuration.learns:
        base = _of_controller(configuration.algo, simulator)
        known = set(base)
    else:
        known = set(inspect.signature(algorithm_class(configuration.algo)).parameters)
        namesake = plain_name(configuration.algo)
        base = {}
        for name in configuration.preset.split("+"):
            if simulator not in ENVIRONMENTS:
                base |= task_settings(namesake, name, simulator, known)
            elif name == "base":
                base |= preset("tuned", base_of(namesake), steps)
            else:
                base |= preset(name, namesake, steps)
        if configuration.algo.startswith("sbx_"):
            base = _for_sbx(base)
    settings = copy.deepcopy(base)
    for key, value in configuration.changes.items():
        if not key.startswith(ENVIRONMENT):
            _set(settings, key.split("."), value)
    for name in settings.keys() - known:
        raise ValueError(f"{configuration.name}: {configuration.algo} has no setting {name!r}.")
    return settings


def _of_controller(algo: str, simulator: str) -> dict[str, Any]:
    """Parameters of a controller: gains, the AP function of the look-ahead oracle, or the deceleration in racing."""
    if algo == "linear" and simulator in GAINS:
        return dict(GAINS[simulator])
    if algo == "oracle" and simulator not in ENVIRONMENTS and has_oracle(simulator):
        return {"ap_function": entry(algo, simulator)["ap_function"]}
    if algo == "scripted" and simulator == RACING:
        return {"deceleration": DECELERATION}
    needed = {
        "linear": "lane keeping",
        "oracle": "a task whose entry in zoo_configs names an AP function, and that can be copied",
        "scripted": RACING,
    }[algo]
    raise ValueError(f"The configuration {algo} is for {needed}, but {simulator} is not.")


def defaults_of(configuration: Configuration, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The constructor's defaults of all other arguments: if a release changes them, the results are no longer valid."""
    if not configuration.learns:
        return {}
    parameters = inspect.signature(algorithm_class(configuration.algo)).parameters.values()
    plain = (bool, int, float, str, tuple, type(None))
    return {p.name: p.default for p in parameters if p.name not in settings and isinstance(p.default, plain)}


def environment_of(configuration: Configuration) -> dict[str, Any]:
    """Options of the training environment that the configuration overrides."""
    return {key.removeprefix(ENVIRONMENT): v for key, v in configuration.changes.items() if key.startswith(ENVIRONMENT)}


def make_model(algo: str, env: Any, settings: Mapping[str, Any], seed: int) -> BaseAlgorithm:
    """Builds a model on the CPU, where networks this small are fastest.

    :param settings: constructor arguments as YAML writes them
    """
    cls = algorithm_class(algo)
    arguments = copy.deepcopy(dict(settings))
    if not issubclass(cls, (SettingsMixin, OnPolicyPermissibilityMixin)):  # which convert YAML values themselves
        if isinstance(arguments.get("action_noise"), Mapping):
            arguments["action_noise"] = make_action_noise(arguments["action_noise"], env.action_space)
        if "learning_rate" in arguments:
            arguments["learning_rate"] = as_schedule(arguments["learning_rate"], "learning_rate")
    if "replay_buffer_class" in arguments:
        arguments["replay_buffer_class"] = resolve(arguments["replay_buffer_class"], "replay_buffer_class")
    if "policy_kwargs" in arguments:
        arguments["policy_kwargs"] = with_extractor(arguments["policy_kwargs"])
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    if algo.startswith("ppo_lstm"):
        policy = policy.replace("Policy", "LstmPolicy")
    return cls(policy, env, seed=seed, device="cpu", **arguments)


def _for_sbx(settings: dict[str, Any]) -> dict[str, Any]:
    """Renames settings for SBX, whose critics have a separate learning rate, by default another one in DDPG and TD3."""
    settings = dict(settings)
    if "learning_rate" in settings:
        settings["qf_learning_rate"] = settings["learning_rate"]
    if "actor_learning_rate" in settings:
        settings["learning_rate"] = settings.pop("actor_learning_rate")
    return settings


def _set(settings: dict[str, Any], path: list[str], value: Any) -> None:
    *folders, name = path
    for folder in folders:
        settings = settings.setdefault(folder, {})
        if not isinstance(settings, dict):
            raise ValueError(f"{'.'.join(path)} cannot be set: {folder!r} is not a mapping.")
    settings[name] = value
