"""Tuning: the search spaces, samplers and pruners, and what becomes of a study."""

import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from quick_runs import ENV, FOLDER, QUICK, optimize, optuna
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.cli.main import main
from sb3_sap.evaluation.laps import ENVIRONMENTS, drive_lap
from sb3_sap.evaluation.policies import load_policy
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.presets import load_config
from sb3_sap.zoo.configs import check_hyperparameters
from sb3_sap.zoo.spaces import t_k_range
from sb3_sap.zoo.storages import SeededByTrial, is_surplus, open_storage, without_password
from sb3_sap.zoo.study_plots import contour

GUIDED = [name for name, cls in ALGORITHMS.items() if issubclass(cls, ActionPermissibilityMixin)]


@pytest.mark.parametrize("algo", GUIDED)
def test_search_space_begins_with_alpha_and_t_k_and_trials_convert_to_what_was_sampled(algo):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    for only in (True, False):
        trial = study.ask()
        arguments = {"using_her_replay_buffer": False, "her_kwargs": {}, "n_timesteps": 3000, "guidance_only": only}
        sampled = HYPERPARAMS_SAMPLER[algo](trial, 1, 1, arguments)
        assert list(trial.params)[:2] == ["alpha", "t_k"]
        assert (len(trial.params) == 2) == only
        converted = HYPERPARAMS_CONVERTER[algo](trial.params)
        sampled.pop("action_noise", None)  # rl_zoo3 builds it from the other two later
        converted = {key: value for key, value in converted.items() if key not in ("noise_type", "noise_std")}
        assert converted == sampled
        check_hyperparameters(algo, sampled, "the search space")
        assert 50 <= sampled["t_k"] <= 1000
    assert t_k_range(15_000) == (250, 5000)


@pytest.mark.parametrize("algo", ON_POLICY_ALGORITHMS)
def test_trials_of_on_policy_algorithms_convert_to_what_was_sampled(algo):
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1)).ask()
    sampled = HYPERPARAMS_SAMPLER[algo](trial, 1, 1, {})
    assert HYPERPARAMS_CONVERTER[algo](trial.params) == sampled
    check_hyperparameters(algo, load_config(algo)["default"] | sampled, "the search space")
    assert sampled["alpha"] in (0, 1)
    assert 1 <= sampled["predictor_epochs"] <= 20
    assert ("permissibility_coef" in sampled) == (algo != "trpo_ap")
    assert set(sampled["predictor_kwargs"]) == {"optimizer_class", "learning_rate", "weight_decay"}


def test_trial_samples_the_same_in_every_worker():
    def draw(number_of_trials):
        sampler = SeededByTrial(lambda seed: optuna.samplers.RandomSampler(seed=seed), 7)
        study = optuna.create_study(sampler=sampler)
        return [study.ask().suggest_float("x", 0, 1) for _ in range(number_of_trials)]

    assert draw(5)[:3] == draw(3)
    assert len(set(draw(5))) == 5


def test_surplus_trial_is_recognised_by_its_number():
    study = optuna.create_study()
    first, second, third = (study.ask() for _ in range(3))
    assert [is_surplus(study, trial.number, 2) for trial in (first, second, third)] == [False, False, True]
    study.tell(first, state=optuna.trial.TrialState.FAIL)
    assert not is_surplus(study, third.number, 2)


def test_passwords_are_hidden():
    shown = without_password("sb3-sap optimize --storage postgresql://me:secret@host:5432/db --study-name s")
    assert shown == "sb3-sap optimize --storage postgresql://me:***@host:5432/db --study-name s"


@pytest.mark.slow
def test_study_is_optimised_replayed_retested_and_plotted(capsys):
    where = ["--storage", "study.log"]
    assert optimize(*where, "--max-total-trials", "4", "--n-startup-trials", "2", "--n-evaluations", "3") == 0
    study = optuna.load_study(study_name="study", storage=open_storage("study.log"))
    assert [trial.user_attrs["seed"] for trial in study.trials] == [100, 101, 102, 103]
    assert study.user_attrs["command"].startswith("sb3-sap optimize --env sap/LaneKeeping-v0 -n 60")
    report = Path("logs/ddpg_ap") / f"report_{FOLDER}_study"
    assert {path.name for path in report.iterdir()} >= {"report.md", "trials.csv", "history.png", "contour.png"}
    assert "| trial | value | alpha | t_k | seed |" in (report / "report.md").read_text()
    # Enough trials have been run already.
    assert optimize(*where, "--max-total-trials", "4") == 0
    assert len(optuna.load_study(study_name="study", storage=open_storage("study.log")).trials) == 4

    # With its own seed, trial 0 is repeated exactly.
    command = ["train", "--env", ENV, "-n", "60", "--eval-freq", "20", "--eval-episodes", "1", "--trial-id", "0"]
    assert main([*command, *where, "--study-name", "study", "-params", *QUICK]) == 0
    [path] = Path("logs").rglob("evaluations.npz")
    evaluations = np.load(path)
    replayed = dict(zip(evaluations["timesteps"].tolist(), evaluations["results"].mean(axis=1).tolist(), strict=True))
    assert replayed == study.trials[0].intermediate_values
    assert list(replayed) == [20, 40, 60]

    command = ["retest", "--env", ENV, "-n", "60", "--best", "1", "--runs", "2", *where, "--study-name", "study"]
    command += ["--out", "retest", "--tracks", "wheel-2", "-params", *QUICK]
    assert main(command) == 0
    table = Path("retest/retest.md").read_text()
    assert "`sb3-sap retest --env sap/LaneKeeping-v0 -n 60 --best 1" in table
    assert "| default |" in table
    assert f"| trial {study.best_trial.number} |" in table
    rows = Path("retest/retest.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 2
    assert rows[1].startswith("default,10000,60,wheel-2,")
    assert main(command) == 0  # finished runs are not trained again
    assert Path("retest/retest.csv").read_text().splitlines() == rows
    command[command.index("wheel-2")] = "eroad"
    assert main(command) == 1
    assert "holds runs of 60 steps on wheel-2" in capsys.readouterr().err

    assert main(["plot", "study", *where, "--study-name", "study", "--out", "drawn"]) == 0
    assert Path("drawn/report.md").exists()


@pytest.mark.slow
@pytest.mark.parametrize("pruner", ["median", "halving"])
def test_trials_are_not_pruned_before_guidance_begins(pruner):
    """Without that, every trial but the first would be pruned at once, because it is worse."""
    decisions = []
    decide = optuna.pruners.MedianPruner.prune, optuna.pruners.SuccessiveHalvingPruner.prune
    for cls, original in zip(
        (optuna.pruners.MedianPruner, optuna.pruners.SuccessiveHalvingPruner), decide, strict=True
    ):

        def prune(self, study, trial, original=original):
            pruned = original(self, study, trial)
            decisions.append((trial.last_step, pruned))
            return pruned

        cls.prune = prune
    try:
        flags = ["--n-trials", "3", "--n-startup-trials", "0", "--n-evaluations", "12", "--pruner", pruner]
        assert optimize("--storage", "study.log", "--no-optim-plots", *flags) == 0
    finally:
        optuna.pruners.MedianPruner.prune, optuna.pruners.SuccessiveHalvingPruner.prune = decide
    assert decisions
    assert not [step for step, pruned in decisions if pruned and step <= t_k_range(60)[1]]


def test_study_in_memory_writes_a_report():
    assert optimize("-n", "20", "--n-trials", "2", "--no-optim-plots", "--optimization-log-path", "trials") == 0
    report = Path("logs/ddpg_ap") / f"report_{FOLDER}_study"
    assert {path.name for path in report.iterdir()} == {"report.md", "trials.csv"}
    assert "| 0 |" in (report / "report.md").read_text()
    assert Path("trials/trial_1/evaluations.npz").exists()


@pytest.mark.parametrize(("n_trials", "title"), [(1, "only 1 trial,"), (6, "only 6 trials,"), (20, "20 trials, the")])
def test_contour_of_few_trials_says_so_in_its_title(n_trials, title):
    study = optuna.create_study(study_name="study", sampler=optuna.samplers.RandomSampler(seed=1))
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1) + trial.suggest_float("y", 0, 1), n_trials)
    [axis, *_] = contour(study, "x", "y", "value").axes
    assert axis.get_title().startswith(f"study: {title}")


def test_tuned_noise_of_none_is_loaded():
    study = optuna.create_study(study_name="study", storage=open_storage("study.log"), direction="maximize")
    space = {"using_her_replay_buffer": False, "her_kwargs": {}}
    study.enqueue_trial({"noise_type": None})
    trial = study.ask()
    HYPERPARAMS_SAMPLER["ddpg_ap"](trial, 1, 1, space)
    study.tell(trial, 1.0)
    assert trial.params["noise_type"] is None
    command = ["train", "--env", ENV, "-n", "10", "--eval-freq", "-1", "--trial-id", "0", "--storage", "study.log"]
    assert main([*command, "--study-name", "study"]) == 0


def test_study_of_another_algorithm_is_not_continued(capsys):
    study = optuna.create_study(study_name="study", storage=open_storage("study.log"))
    study.set_user_attr("algo", "sac_ap")
    assert optimize("--storage", "study.log") == 1
    assert "is one of sac_ap on sap/LaneKeeping-v0, not of ddpg_ap" in capsys.readouterr().err


def test_help_lists_options_of_this_package_and_of_rl_zoo(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["optimize", "--help"])
    text = capsys.readouterr().out
    assert "--guidance-only" in text
    assert "--n-startup-trials" in text


@pytest.mark.slow
@pytest.mark.parametrize("simulator", ["highway", "torcs"])
def test_study_maximises_the_score_of_laps(simulator):
    """The value of a trial is the mean score that `sb3-sap evaluate` gives the model that it saved."""
    if simulator == "torcs":
        try:
            gym.make(ENVIRONMENTS["torcs"])
        except (OSError, RuntimeError) as error:
            if os.environ.get("SB3_SAP_REQUIRE_TORCS"):
                raise
            pytest.skip(str(error))
    tracks = ["random:3", "random:4"] if simulator == "highway" else ["g-track-1", "e-track-1"]
    command = ["optimize", "--env", ENVIRONMENTS[simulator], "--validation-tracks", *tracks, "-n", "100"]
    command += [
        "--n-trials",
        "1",
        "--study-name",
        "laps",
        "--storage",
        "study.log",
        "--optimization-log-path",
        "trials",
    ]
    assert main([*command, "--guidance-only", "--no-optim-plots", "-params", *QUICK]) == 0
    [trial] = optuna.load_study(study_name="laps", storage=open_storage("study.log")).trials
    policy = load_policy(Path("trials/trial_0/best_model.zip"))
    scores = [drive_lap(policy, track, simulator).score for track in tracks]
    assert trial.value == pytest.approx(np.mean(scores), abs=1e-5)
