"""rl_zoo3's ExperimentManager with corrections: each method here corrects one fault of rl_zoo3 2.9.2."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER
from rl_zoo3.utils import get_class_by_name
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.zoo.configs import check_file, check_hyperparameters, evaluation_options, packaged
from sb3_sap.zoo.storages import SeededByTrial, check_belongs, load_study


class CallbacksEndingOnce(CallbackList):
    """Calls ``on_training_end`` once, and not at all if the training never began."""

    def __init__(self, callbacks: list[BaseCallback]):
        super().__init__(callbacks)
        self._running = False

    def _on_training_start(self) -> None:
        self._running = True
        super()._on_training_start()

    def on_training_end(self) -> None:
        if self._running:
            self._running = False
            super().on_training_end()


class GuidedExperimentManager(ExperimentManager):
    """Reads, checks and completes hyperparameters, then trains."""

    def __init__(
        self,
        args: argparse.Namespace,
        algo: str,
        *positional: Any,
        trial_id: int | None = None,
        **kwargs: Any,
    ):
        super().__init__(args, algo, *positional, **kwargs)
        # rl_zoo3 looks for configurations in its own folder only.
        self.config = kwargs.get("config") or packaged(algo) or self.config
        # rl_zoo3 takes trial 0 for no trial; the text "0" is not false.
        self.trial_id: Any = None if trial_id is None else str(trial_id)
        if trial_id is not None and not (self.storage and self.study_name):
            raise ValueError("`--trial-id` needs the study that it belongs to: give `--storage` and `--study-name`.")

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        # rl_zoo3 does not check keys: a wrong one fails later, wherever it is used first.
        check_file(self.config)
        hyperparams, saved = super().read_hyperparameters()
        check_hyperparameters(self.algo, hyperparams, Path(self.config).name)
        # rl_zoo3 evaluates without the entry's options of the environment, where the spaces may differ.
        if not self._eval_env_kwargs_args and not self.env_kwargs:
            self.eval_env_kwargs = evaluation_options(hyperparams)
        return hyperparams, saved

    def load_trial(
        self, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True
    ) -> dict[str, Any]:
        # rl_zoo3 knows two kinds of storage only, and raises an IndexError for an unknown number.
        study = load_study(storage, study_name)
        check_belongs(study, self.algo, self.env_name.gym_id)
        trials = {trial.number: trial for trial in study.trials}
        number = study.best_trial.number if trial_id is None else int(trial_id)
        if number not in trials:
            raise ValueError(f"`--trial-id` {number} is none of the {len(trials)} trials of the study {study_name!r}.")
        params = trials[number].params
        return HYPERPARAMS_CONVERTER[self.algo](params) if convert else params

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Callable[..., Any] | None, list[BaseCallback], Callable[..., Any] | None]:
        # rl_zoo3 evaluates this as Python, in which a dotted name means nothing.
        buffer_class = hyperparams.get("replay_buffer_class")
        if isinstance(buffer_class, str) and "." in buffer_class:
            hyperparams["replay_buffer_class"] = get_class_by_name(buffer_class)
        return super()._preprocess_hyperparams(hyperparams)

    def _preprocess_action_noise(
        self, hyperparams: dict[str, Any], saved_hyperparams: dict[str, Any], env: VecEnv
    ) -> dict[str, Any]:
        # rl_zoo3 passes a tuned `noise_type: None` on to the constructor, which has no such argument.
        if hyperparams.get("noise_type", "") is None:
            del hyperparams["noise_type"]
            hyperparams.pop("noise_std", None)
        hyperparams = super()._preprocess_action_noise(hyperparams, saved_hyperparams, env)
        return self.explore_until_t_k(hyperparams) if self.trial_id else hyperparams

    def explore_until_t_k(self, hyperparams: dict[str, Any]) -> dict[str, Any]:
        """Without ``action_noise``, lets the uniform random steps end at a tuned t_k.

        Otherwise a deterministic policy would not explore at all between them and t_k.
        """
        algorithm: Any = ALGOS[self.algo]
        without_noise = hyperparams.get("action_noise") is None and "learning_starts" not in hyperparams
        deterministic = issubclass(algorithm, ActionPermissibilityMixin) and not algorithm.explores_without_noise
        if "t_k" in hyperparams and without_noise and deterministic:
            return {**hyperparams, "learning_starts": hyperparams["t_k"]}
        return hyperparams

    def learn(self, model: BaseAlgorithm) -> None:
        # rl_zoo3 ends the training of the first callback twice and, if interrupted, that of the others never.
        if self.callbacks:
            self.callbacks = [CallbacksEndingOnce(self.callbacks)]
        super().learn(model)

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        # Workers that share a seed would all try the same hyperparameters first.
        if sampler_method == "auto":
            try:
                return super()._create_sampler(sampler_method)
            except ModuleNotFoundError as error:
                raise ValueError(
                    f"`--sampler auto` comes from OptunaHub, over the network, and {error.name} is missing: "
                    "pip install optunahub cmaes, or choose tpe or random."
                ) from error

        def make(seed: int) -> optuna.samplers.BaseSampler:
            manager = copy.copy(self)
            manager.seed = seed
            return ExperimentManager._create_sampler(manager, sampler_method)

        return SeededByTrial(make, self.seed)
