"""The best trials of a study and the default settings, trained on fresh seeds to see whether the best were lucky."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sap.common.files import atomic_path
from sb3_sap.evaluation.statistics import bootstrap_difference, bootstrap_interval, interquartile_mean
from sb3_sap.zoo import study_plots
from sb3_sap.zoo.storages import check_belongs, load_study, without_password
from sb3_sap.zoo.study_report import formatted, markdown_table, target_name
from sb3_sap.zoo.tuning import StudyManager

#: Name of the settings that change nothing.
DEFAULT = "default"


class RetestManager(StudyManager):
    """Trains the best trials and the default settings again, instead of tuning."""

    def hyperparameters_optimization(self) -> None:
        if not (self.storage and self.study_name):
            raise ValueError("`retest` needs a study: give `--storage` and `--study-name`.")
        if self.n_jobs != 1:
            raise ValueError("`retest` trains one model after the other: leave `--n-jobs` out.")
        study = load_study(self.storage, self.study_name)
        check_belongs(study, self.algo, self.env_name.gym_id)
        self._follow(study)
        folder = self.options.out or Path(self.log_folder) / self.algo / f"retest_{self.env_name}_{self.study_name}"
        rows = self._train_all(arms(study, self.algo, self.options.best), folder / "retest.csv")
        text = summary(rows, study, self.options.tracks or self.options.validation_tracks, self.options.command)
        with atomic_path(folder / "retest.md") as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"{text}\nThe comparison is in {folder}")

    def _follow(self, study: optuna.Study) -> None:
        """Evaluates as the study did, unless flags say otherwise."""
        steps = study.user_attrs.get("n_timesteps", self.n_timesteps)
        if steps != self.n_timesteps:
            print(f"Note: the study trained {steps} steps, this trains {self.n_timesteps}.")
        tracks = self.options.tracks or self.options.validation_tracks or study.user_attrs.get("validation_tracks", [])
        self.options.validation_tracks = tracks
        if tracks:
            self.n_eval_episodes, self.n_eval_envs = len(tracks), 1

    def _train_all(self, settings: dict[str, dict[str, Any]], path: Path) -> pd.DataFrame:
        """One row for each run and track; runs that the file holds already are not repeated."""
        rows = self._rows_of(path)
        for seed in range(self.seed, self.seed + self.options.runs):  # seed by seed, so that a part is a comparison too
            for arm, hyperparams in settings.items():
                if ((rows["arm"] == arm) & (rows["seed"] == seed)).any():
                    continue
                scores = self._train(hyperparams, seed)
                print(f"{arm}, seed {seed}: {np.mean(scores):.4g}", flush=True)
                run = {"arm": arm, "seed": seed, "steps": int(self.n_timesteps)}
                tasks = self.options.validation_tracks or [self.env_name.gym_id] * len(scores)
                new = [run | {"task": task, "score": score} for task, score in zip(tasks, scores, strict=True)]
                rows = pd.DataFrame([*rows.to_dict("records"), *new])
                with atomic_path(path) as temporary:
                    rows.to_csv(temporary, index=False)
        return rows

    def _rows_of(self, path: Path) -> pd.DataFrame:
        """What the file holds, if it is of the same steps and tracks: others cannot be compared."""
        if not path.exists():
            return pd.DataFrame(columns=["arm", "seed", "steps", "task", "score"])
        rows = pd.read_csv(path)
        tasks = self.options.validation_tracks or [self.env_name.gym_id]
        if set(rows["steps"]) - {int(self.n_timesteps)} or set(rows["task"]) - set(tasks):
            raise ValueError(
                f"{path} holds runs of {', '.join(map(str, sorted(set(rows['steps']))))} steps on "
                f"{', '.join(sorted(set(rows['task'])))}, which are not to be compared with runs of {self.n_timesteps} "
                f"on {', '.join(tasks)}: give another `--out`."
            )
        return rows

    def _train(self, hyperparams: dict[str, Any], seed: int) -> list[float]:
        model = self.build(hyperparams, seed)
        model.learn(self.n_timesteps)
        eval_env = self.create_envs(self.n_eval_envs, eval_env=True)  # a new one begins with the first track
        normalised = model.get_vec_normalize_env()
        if normalised is not None:
            eval_env.obs_rms = normalised.obs_rms  # type: ignore[attr-defined]
        scores, _ = evaluate_policy(
            model, eval_env, self.n_eval_episodes, self.deterministic_eval, return_episode_rewards=True
        )
        model.env.close()  # type: ignore[union-attr]
        eval_env.close()
        return [float(score) for score in scores]  # type: ignore[union-attr]


def arms(study: optuna.Study, algo: str, best: int) -> dict[str, dict[str, Any]]:
    """What the default and the best trials change in the configuration, by name."""
    done = sorted(study_plots.completed(study), key=lambda trial: float(trial.value or 0), reverse=True)
    if not done:
        raise ValueError(f"No trial of the study {study.study_name!r} has finished.")
    winners = {f"trial {trial.number}": HYPERPARAMS_CONVERTER[algo](trial.params) for trial in done[:best]}
    return {DEFAULT: {}, **winners}


def summary(rows: pd.DataFrame, study: optuna.Study, tracks: list[str], command: str) -> str:
    """The comparison as Markdown: interquartile means with 95 % intervals, and differences to the default."""
    scores = {arm: _matrix(group) for arm, group in rows.groupby("arm", sort=False)}
    trials = {f"trial {trial.number}": trial for trial in study.get_trials(deepcopy=False)}
    table = []
    for arm, matrix in scores.items():
        trial = trials.get(str(arm))
        changed = ", ".join(f"{name} {formatted(value)}" for name, value in trial.params.items()) if trial else ""
        row = [arm, changed, formatted(trial.value) if trial else "", len(matrix)]
        row.append(f"{interquartile_mean(matrix):.4g}" + _interval(bootstrap_interval(matrix), ".4g", matrix))
        if arm == DEFAULT or DEFAULT not in scores:
            row.append("")
        else:
            difference, *interval = bootstrap_difference(matrix, scores[DEFAULT])
            row.append(f"{difference:+.3g}" + _interval(interval, "+.3g", matrix, scores[DEFAULT]))
        table.append(row)
    header = ["settings", "changed", "in the study", "seeds", "interquartile mean", "minus default"]
    tasks = f"Laps: {', '.join(tracks)}." if tracks else f"{target_name(study).capitalize()}."
    title, made = f"# Winners of {study.study_name} on fresh seeds", f"`{without_password(command)}`"
    intervals = "95 % stratified bootstrap intervals."
    if any(len(matrix) == 1 for matrix in scores.values()):
        alone = all(len(matrix) == 1 for matrix in scores.values())
        intervals = "One seed: no interval." if alone else f"{intervals} Where there is one seed: no interval."
    lines = [title, "", made, "", f"{tasks} {intervals}", ""]
    return "\n".join([*lines, *markdown_table(header, table)]) + "\n"


def _interval(interval: Sequence[float], digits: str, *matrices: Any) -> str:
    """The interval in brackets; empty if a matrix has a single run, which does not show how much runs scatter."""
    low, high = interval
    return "" if any(len(matrix) == 1 for matrix in matrices) else f" [{low:{digits}}, {high:{digits}}]"


def _matrix(rows: pd.DataFrame) -> Any:
    """(runs, tasks); several episodes on one environment are averaged."""
    return rows.pivot_table(index="seed", columns="task", values="score", aggfunc="mean").to_numpy()
