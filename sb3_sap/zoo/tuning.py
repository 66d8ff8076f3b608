"""Tuning with Optuna: rl_zoo3's study, with seeded trials that several workers share."""

from __future__ import annotations

import copy
import os
import platform
from pathlib import Path
from pprint import pformat
from typing import Any

import numpy as np
import optuna
from huggingface_sb3 import EnvironmentName
from optuna.pruners import BasePruner, MedianPruner, SuccessiveHalvingPruner
from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from rl_zoo3.utils import get_callback_list
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.zoo import laps
from sb3_sap.zoo.manager import GuidedExperimentManager
from sb3_sap.zoo.options import StudyOptions, check_validation_tracks
from sb3_sap.zoo.spaces import t_k_range
from sb3_sap.zoo.storages import check_belongs, is_surplus, open_storage, without_password
from sb3_sap.zoo.study_report import write_report
from sb3_sap.zoo.trial_callback import ReportingCallback
from sb3_sap.zoo.workers import SurplusTrial, count_workers, end_with_parent, run_workers, work_until


class StudyManager(GuidedExperimentManager):
    """Runs studies whose trials several workers share."""

    def __init__(self, *args: Any, options: StudyOptions | None = None, **kwargs: Any):
        self.options = options or StudyOptions()
        super().__init__(*args, **kwargs)
        check_validation_tracks(self.options.validation_tracks, self.env_name.gym_id)
        if self.options.validation_tracks:
            self.n_eval_episodes, self.n_eval_envs = len(self.options.validation_tracks), 1
        if self.options.guidance_only and not issubclass(ALGOS[self.algo], ActionPermissibilityMixin):
            raise ValueError(
                f"`--guidance-only` tunes alpha and t_k, which {self.algo} has not: leave it out, or choose a guided "
                "algorithm, such as ddpg_ap."
            )

    # ---------------------------------------------------------------- one trial

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        if not (eval_env and self.options.validation_tracks):
            return super().create_envs(n_envs, eval_env, no_log)
        laps_manager = copy.copy(self)
        laps_manager.options = StudyOptions()
        laps_manager.eval_env_kwargs = {
            **self.eval_env_kwargs,
            "env_id": self.env_name.gym_id,
            "tracks": self.options.validation_tracks,
        }
        laps_manager.env_name = EnvironmentName(laps.ENV_ID)
        return laps_manager.create_envs(n_envs, eval_env, no_log)

    def build(self, hyperparams: dict[str, Any], seed: int) -> BaseAlgorithm:
        """A model with hyperparameters in place of the configuration's, and a seed of its own."""
        kwargs = copy.deepcopy(self._hyperparams)
        kwargs.update(hyperparams)
        return ALGOS[self.algo](
            env=self.create_envs(self.n_envs, no_log=True),
            tensorboard_log=None,
            seed=seed,
            verbose=self.verbose if self.verbose >= 2 else 0,
            device=self.device,
            **(self.explore_until_t_k(kwargs) if hyperparams else kwargs),
        )

    def objective(self, trial: optuna.Trial) -> float:
        if self.max_total_trials is not None and is_surplus(trial.study, trial.number, self.max_total_trials):
            raise SurplusTrial(f"{self.max_total_trials} trials came before")
        # A trial that another worker left behind keeps its seed.
        seed = trial.user_attrs.get("seed", self.seed + trial.number)
        trial.set_user_attr("seed", seed)
        trial.set_user_attr("worker", f"{platform.node()}:{os.getpid()}")
        sampled = HYPERPARAMS_SAMPLER[self.algo](trial, self.n_actions, self.n_envs, self._sampler_arguments())
        eval_env, model = self.create_envs(self.n_eval_envs, eval_env=True), self.build(sampled, seed)
        path = f"{self.optimization_log_path}/trial_{trial.number}" if self.optimization_log_path else None
        callback = ReportingCallback(
            eval_env,
            trial,
            best_model_save_path=path,
            log_path=path,
            n_eval_episodes=self.n_eval_episodes,
            eval_freq=max(self.n_timesteps // self.n_evaluations // self.n_envs, 1),
            deterministic=self.deterministic_eval,
        )
        try:
            model.learn(
                self.n_timesteps, callback=[*get_callback_list({"callback": self.specified_callbacks}), callback]
            )
        except (AssertionError, ArithmeticError, ValueError) as error:
            # Some hyperparameters make networks diverge to NaN.
            print(f"Trial {trial.number} is given up: {error}\n{pformat(sampled)}")
            raise optuna.TrialPruned from error
        finally:
            model.env.close()  # type: ignore[union-attr]
            eval_env.close()
        if callback.is_pruned or not np.isfinite(callback.last_mean_reward):
            raise optuna.TrialPruned
        return float(callback.last_mean_reward)

    def _sampler_arguments(self) -> dict[str, Any]:
        return {
            "using_her_replay_buffer": self._hyperparams.get("replay_buffer_class") == HerReplayBuffer,
            "her_kwargs": self._hyperparams.get("replay_buffer_kwargs", {}),
            "n_timesteps": self.n_timesteps,
            "guidance_only": self.options.guidance_only,
        }

    # ---------------------------------------------------------------- the study

    def guidance_begins(self) -> int:
        """The first step at which every trial is guided; 0 for an algorithm that never is."""
        algorithm: Any = ALGOS[self.algo]
        return t_k_range(self.n_timesteps)[1] + 1 if issubclass(algorithm, ActionPermissibilityMixin) else 0

    def _create_pruner(self, pruner_method: str) -> BasePruner:
        # rl_zoo3 counts evaluations, and would prune before every trial is guided.
        begins = max(self.guidance_begins(), self.n_timesteps // 3)
        if pruner_method == "halving":
            return SuccessiveHalvingPruner(min_resource=begins)
        if pruner_method == "median":
            return MedianPruner(n_startup_trials=self.n_startup_trials, n_warmup_steps=begins)
        return super()._create_pruner(pruner_method)

    def hyperparameters_optimization(self) -> None:
        n_workers = count_workers(self.n_jobs, self.max_total_trials or self.n_trials)
        if n_workers > 1 and self.storage is None:
            self.storage = str(Path(self.save_path) / "study.log")
            print(f"The study is kept in {self.storage}")
        study = optuna.create_study(
            sampler=self._create_sampler(self.sampler),
            pruner=self._create_pruner(self.pruner),
            storage=open_storage(self.storage, self.options.heartbeat),
            study_name=self.study_name,
            load_if_exists=True,
            direction="maximize",
        )
        self._describe(study)
        if self.options.worker:
            end_with_parent()
        try:
            if n_workers > 1:
                flags = ["--storage", str(self.storage), "--study-name", study.study_name, "--seed", str(self.seed)]
                run_workers(self.options.command, n_workers, self.n_trials, flags)
            elif self.max_total_trials is None:
                study.optimize(self.objective, n_trials=self.n_trials, gc_after_trial=True)
            else:
                work_until(study, self.objective, self.max_total_trials)
        except KeyboardInterrupt:
            print("Interrupted: the finished trials remain in the study.")
        if not self.options.worker:
            self._report(study)

    def _report(self, study: optuna.Study) -> None:
        folder = write_report(study, self.log_folder, self.algo, self.env_name, pictures=not self.no_optim_plots)
        print((folder / "report.md").read_text(encoding="utf-8"))
        print(f"The report is in {folder}")

    def _describe(self, study: optuna.Study) -> None:
        check_belongs(study, self.algo, self.env_name.gym_id)
        if "command" in study.user_attrs:
            return
        study.set_user_attr("command", without_password(self.options.command))
        study.set_user_attr("algo", self.algo)
        study.set_user_attr("env", self.env_name.gym_id)
        study.set_user_attr("n_timesteps", self.n_timesteps)
        study.set_user_attr("validation_tracks", self.options.validation_tracks)
        study.set_user_attr("hyperparams", {key: str(value) for key, value in sorted(self._hyperparams.items())})
