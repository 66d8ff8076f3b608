"""RL Zoo's commands as a user types them, with runs of some ten steps: what they leave, and what they say is wrong."""

import io
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import yaml

optuna = pytest.importorskip("optuna", reason="RL Zoo is not installed: pip install sb3-sap[zoo]")
rl_zoo3 = pytest.importorskip("rl_zoo3", reason="RL Zoo is not installed: pip install sb3-sap[zoo]")

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402

from sb3_sap import DDPGAP  # noqa: E402
from sb3_sap.algorithms import ALGORITHMS  # noqa: E402
from sb3_sap.cli.main import main  # noqa: E402
from sb3_sap.evaluation.laps import ENVIRONMENTS, drive_lap  # noqa: E402
from sb3_sap.evaluation.policies import load_policy  # noqa: E402
from sb3_sap.guidance.mixin import ActionPermissibilityMixin  # noqa: E402
from sb3_sap.presets import load_config  # noqa: E402
from sb3_sap.zoo.configs import check_hyperparameters  # noqa: E402
from sb3_sap.zoo.registration import register, small_buffers  # noqa: E402
from sb3_sap.zoo.retest import summary  # noqa: E402
from sb3_sap.zoo.spaces import t_k_range  # noqa: E402
from sb3_sap.zoo.storages import SeededByTrial, is_surplus, open_storage, without_password  # noqa: E402
from sb3_sap.zoo.study_plots import contour  # noqa: E402
from sb3_sap.zoo.workers import count_workers, run_workers  # noqa: E402

ENV = "sap/LaneKeeping-v0"
FOLDER = "sap-LaneKeeping-v0"
GUIDED = [name for name, cls in ALGORITHMS.items() if issubclass(cls, ActionPermissibilityMixin)]
#: Small networks, and fits of E from the first steps on.
QUICK = [
    "policy_kwargs:dict(net_arch=[8])",
    "predictor_kwargs:dict(net_arch=[8])",
    "batch_size:8",
    "buffer_size:500",
    "dataset_size:16",
    "min_per_class:1",
    "n_candidates:8",
    "validation_size:8",
]

register()


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


class CountsEnds(BaseCallback):
    """Named in YAML by its dotted name."""

    ends = 0

    def _on_step(self):
        return True

    def _on_training_end(self):
        type(self).ends += 1


# -------------------------------------------------------------------- train, enjoy


def test_train_leaves_what_rl_zoo_leaves():
    command = ["train", "--algo", "ddpg_ap", "--env", ENV, "-n", "60", "--eval-freq", "30", "--eval-episodes", "1"]
    command += ["--save-freq", "20", "--save-replay-buffer", "--seed", "3", "-P", "-params", "alpha:0.7", *QUICK]
    assert main(command) == 0
    run = Path("logs/ddpg_ap") / f"{FOLDER}_1"
    checkpoints = {f"rl_model_{steps}_steps.zip" for steps in (20, 40, 60)}
    assert checkpoints | {"best_model.zip", "replay_buffer.pkl", f"{FOLDER}.zip"} <= {
        path.name for path in run.iterdir()
    }
    model = DDPGAP.load(run / f"{FOLDER}.zip")
    assert (model.alpha, model.refit_growth, model.seed, model.num_timesteps) == (0.7, 0.005, 3, 60)
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [30, 60]
    saved, _ = rl_zoo3.get_saved_hyperparams(str(run / FOLDER))
    assert saved["alpha"] == 0.7

    again = [
        "train",
        "--env",
        ENV,
        "-n",
        "10",
        "--eval-freq",
        "-1",
        "-i",
        str(run / f"{FOLDER}.zip"),
        "-params",
        *QUICK,
    ]
    assert main(again) == 0
    model = DDPGAP.load(Path("logs/ddpg_ap") / f"{FOLDER}_2" / f"{FOLDER}.zip")
    assert model.num_timesteps == 10
    assert model._steps_of_earlier_learns == 60  # t_k counts over the model's life

    printed = io.StringIO()
    with redirect_stdout(printed):
        assert main(["enjoy", "--env", ENV, "--no-render", "-n", "30", "--exp-id", "1", "--load-best"]) == 0
    assert "best_model.zip" in printed.getvalue()


def test_the_default_entry_serves_other_environments():
    command = ["train", "--algo", "sac_ap", "--env", "MountainCarContinuous-v0", "-n", "20", "--eval-freq", "-1"]
    command += ["--conf-file", "own.yml", "-params", "policy_kwargs:dict(net_arch=[8])"]
    settings = {"policy": "MlpPolicy", "n_timesteps": 20, "ap_function": "tests_ap.never", "callback": ["counts.Ends"]}
    Path("own.yml").write_text(yaml.safe_dump({"default": settings}))
    assert main(command) == 1  # there are no such modules
    settings |= {"ap_function": f"{__name__}.all_permissible", "callback": [f"{__name__}.CountsEnds"]}
    Path("own.yml").write_text(yaml.safe_dump({"default": settings}))
    CountsEnds.ends = 0
    assert main(command) == 0
    assert CountsEnds.ends == 1  # rl_zoo3 tells the first callback twice


def test_modules_of_the_current_folder_are_found(monkeypatch):
    """As `python -m sb3_sap.zoo` finds them; the console command has its own folder on the path instead."""
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != os.getcwd()])
    Path("nearby_env.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('Nearby-v0', 'gymnasium.envs.classic_control:PendulumEnv', max_episode_steps=5)\n"
        "def fine(obs, actions, next_obs):\n    return obs[:, 0] == obs[:, 0]\n"
    )
    entry = {"policy": "MlpPolicy", "n_timesteps": 20, "ap_function": "nearby_env.fine"}
    Path("own.yml").write_text(yaml.safe_dump({"default": entry}))
    command = ["train", "--gym-packages", "nearby_env", "--env", "Nearby-v0", "-n", "6", "--eval-freq", "-1"]
    assert main([*command, "--conf-file", "own.yml", "-params", *QUICK]) == 0
    assert sys.path.count(os.getcwd()) == 1


def all_permissible(obs, actions, next_obs):
    return np.ones(len(actions), dtype=bool)


def test_watching_needs_no_buffers(tmp_path):
    DDPGAP("MlpPolicy", rl_zoo3.create_test_env(ENV, should_render=False, hyperparams={}), seed=1).save("model")
    with small_buffers():
        model = rl_zoo3.ALGOS["ddpg_ap"].load("model")
    assert (model.replay_buffer.buffer_size, model.buffer_size) == (1, 1)
    assert rl_zoo3.ALGOS["ddpg_ap"] is DDPGAP


# -------------------------------------------------------------------- what is wrong


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--algo", "ddpg_pa"], "`--algo` 'ddpg_pa' is unknown: did you mean 'ddpg_ap'?"),
        (["--env", "sap/LaneKepping-v0"], "did you mean|maybe meant sap/LaneKeeping-v0"),
        (["-params", "alfa:0.7"], "the key 'alfa' is unknown to ddpg_ap: did you mean 'alpha'?"),
        (["-params", "gamma:'high'"], "`gamma` must be float, but is 'high'"),
        (["-params", "batch_size:12.5"], "`batch_size` must be int, but is 12.5"),
        (["-params", "alpha:2"], "`alpha` is a probability from 0 to 1, but is 2"),
        (["-params", "learning_rate:'1e-3'"], "write it with a point, 1.0e-3."),
        (["-params", "policy:'MlpPolcy'"], "did you mean 'MlpPolicy'?"),
        (["-params", "normalize:True", "frame_stack:2"], "ddpg_ap cannot have `normalize` and `frame_stack` together"),
        (
            ["--algo", "sac", "-params", "normalize:dict(norm_obs=False)", "frame_stack:3"],
            "VecFrameStack: {n_stack: 3}}]",
        ),
        (["--gym-packages", "json", "my_env"], "`--gym-packages`: 'my_env' cannot be imported (No module named"),
        (["--conf-file", "nowhere.yml"], "There is no configuration file nowhere.yml"),
        (["--trial-id", "0"], "give `--storage` and `--study-name`"),
        (["--validation-tracks", "eroad"], "one of the paper's test tracks"),
        (["--algo", "ddpg", "--guidance-only"], "which ddpg has not"),
        (["-optimize", "--sampler", "auto"], "OptunaHub, over the network, and optunahub is missing"),
        (
            ["-optimize", "--n-jobs", "0"],
            "`--n-jobs` must be at least 1, or -1 for a worker of each processor, but is 0.",
        ),
        (["--storage", "study.sqlite", "--study-name", "x", "--trial-id", "0"], "neither a database URL"),
        (["--storage", "sqlite:///empty.db", "--study-name", "x", "--trial-id", "0"], "There is no study 'x'"),
        (["--storage", "sqlite:////no/folder/x.db", "--study-name", "x", "--trial-id", "0"], "cannot be opened"),
    ],
)
def test_one_sentence(arguments, sentence, capsys):
    environment = [] if "--env" in arguments else ["--env", ENV]
    assert main(["train", *environment, "-n", "10", *arguments]) == 1
    error = capsys.readouterr().err
    assert re.search(sentence if "|" in sentence else re.escape(sentence), error)
    assert error.startswith("sb3-sap: error: ")
    assert error.count("\n") == 1


def test_values_that_are_no_python(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["train", "--env", ENV, "-params", "alpha:high"])
    assert "'high' is no Python" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("- 1", "must hold environments with their settings, but holds a list"),
        ("default: 3", "the entry 'default' must hold settings"),
        ("default: {gamma: 0.9", "is not YAML"),
        ("sap/LaneKepping-v0: {policy: MlpPolicy}", "did you mean 'sap/LaneKeeping-v0'?"),
        (
            "default: {policy: MlpPolicy, n_timesteps: 10, t_kk: 5}",
            "the key 't_kk' is unknown to ddpg_ap: did you mean 't_k'?",
        ),
        (
            "default: {policy: MlpPolicy, n_timesteps: 10, normalize: '{\"norm_reward\": False}', frame_stack: 2}",
            "own.yml: ddpg_ap cannot have `normalize` and `frame_stack` together",
        ),
        ("default: {policy: MlpPolicy, n_timesteps: 10, env_wrapper: gymnasium.Nothing}", "cannot be imported"),
    ],
)
def test_what_is_wrong_with_a_yaml_file(text, sentence, capsys):
    Path("own.yml").write_text(text)
    assert main(["train", "--env", ENV, "-n", "10", "--conf-file", "own.yml"]) == 1
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("ppo", {"normalize": True, "frame_stack": 2}),  # which keeps what it is given
        ("sac", {"normalize": False, "frame_stack": 2}),
        ("sac", {"normalize": True, "frame_stack": 1}),
    ],
)
def test_frames_may_be_stacked_where_nothing_is_normalised_below(algo, settings):
    check_hyperparameters(algo, settings, "own.yml")


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_config_of_ours_is_right(algo):
    for name, entry in load_config(algo).items():
        check_hyperparameters(algo, entry, name)


# -------------------------------------------------------------------- search spaces


@pytest.mark.parametrize("algo", GUIDED)
def test_alpha_and_t_k_come_first_and_a_trial_converts_to_what_was_sampled(algo):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    for only in (True, False):
        trial = study.ask()
        arguments = {"using_her_replay_buffer": False, "her_kwargs": {}, "n_timesteps": 3000, "guidance_only": only}
        sampled = HYPERPARAMS_SAMPLER[algo](trial, 1, 1, arguments)
        assert list(trial.params)[:2] == ["alpha", "t_k"]
        assert (len(trial.params) == 2) == only
        converted = HYPERPARAMS_CONVERTER[algo](trial.params)
        sampled.pop("action_noise", None)  # rl_zoo3 makes it of these two later
        converted = {key: value for key, value in converted.items() if key not in ("noise_type", "noise_std")}
        assert converted == sampled
        check_hyperparameters(algo, sampled, "the search space")
        assert 50 <= sampled["t_k"] <= 1000
    assert t_k_range(15_000) == (250, 5000)


def test_a_trial_draws_the_same_in_whichever_worker():
    def draw(number_of_trials):
        sampler = SeededByTrial(lambda seed: optuna.samplers.RandomSampler(seed=seed), 7)
        study = optuna.create_study(sampler=sampler)
        return [study.ask().suggest_float("x", 0, 1) for _ in range(number_of_trials)]

    assert draw(5)[:3] == draw(3)
    assert len(set(draw(5))) == 5


def test_a_trial_too_many_is_known_by_its_number():
    study = optuna.create_study()
    first, second, third = (study.ask() for _ in range(3))
    assert [is_surplus(study, trial.number, 2) for trial in (first, second, third)] == [False, False, True]
    study.tell(first, state=optuna.trial.TrialState.FAIL)
    assert not is_surplus(study, third.number, 2)


def test_passwords_are_not_shown():
    shown = without_password("sb3-sap optimize --storage postgresql://me:secret@host:5432/db --study-name s")
    assert shown == "sb3-sap optimize --storage postgresql://me:***@host:5432/db --study-name s"


# -------------------------------------------------------------------- optimize, replay, retest


def optimize(*flags):
    command = ["optimize", "--env", ENV, "-n", "60", "--eval-episodes", "1", "--guidance-only", "--study-name", "study"]
    return main([*command, *flags, "-params", *QUICK])


@pytest.mark.slow
def test_optimize_replay_retest(capsys):
    where = ["--storage", "study.log"]
    assert optimize(*where, "--max-total-trials", "4", "--n-startup-trials", "2", "--n-evaluations", "3") == 0
    study = optuna.load_study(study_name="study", storage=open_storage("study.log"))
    assert [trial.user_attrs["seed"] for trial in study.trials] == [100, 101, 102, 103]
    assert study.user_attrs["command"].startswith("sb3-sap optimize --env sap/LaneKeeping-v0 -n 60")
    report = Path("logs/ddpg_ap") / f"report_{FOLDER}_study"
    assert {path.name for path in report.iterdir()} >= {"report.md", "trials.csv", "history.png", "contour.png"}
    assert "| trial | value | alpha | t_k | seed |" in (report / "report.md").read_text()
    # Enough were run already.
    assert optimize(*where, "--max-total-trials", "4") == 0
    assert len(optuna.load_study(study_name="study", storage=open_storage("study.log")).trials) == 4

    # Trial 0 again, with its own seed, is trial 0 again.
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
    assert main(command) == 0  # what is there is not trained again
    assert Path("retest/retest.csv").read_text().splitlines() == rows
    command[command.index("wheel-2")] = "eroad"
    assert main(command) == 1
    assert "holds runs of 60 steps on wheel-2" in capsys.readouterr().err

    assert main(["plot", "study", *where, "--study-name", "study", "--out", "drawn"]) == 0
    assert Path("drawn/report.md").exists()


@pytest.mark.slow
def test_trials_of_workers_side_by_side_are_those_of_one():
    flags = ["--n-trials", "3", "--n-startup-trials", "3", "--no-optim-plots"]
    assert optimize("--storage", "one.log", *flags) == 0
    assert optimize("--n-jobs", "2", *flags) == 0
    [file] = Path("logs").rglob("study.log")  # where a study is kept of which no storage was named
    alone, together = (
        optuna.load_study(study_name="study", storage=open_storage(str(path))).trials for path in ("one.log", file)
    )
    assert [(t.params, t.user_attrs["seed"], t.value) for t in together] == [
        (t.params, t.user_attrs["seed"], t.value) for t in alone
    ]
    assert len({trial.user_attrs["worker"] for trial in together}) == 2


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_command_that_started_them(end):
    command = [sys.executable, "-m", "sb3_sap.zoo", "optimize", "--env", ENV, "-n", "100000", "--guidance-only"]
    command += ["--n-jobs", "2", "--storage", "study.log", "--study-name", "study"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    running = optuna.trial.TrialState.RUNNING

    def trials():
        if not Path("study.log").exists():
            return []
        try:
            return optuna.load_study(study_name="study", storage=open_storage("study.log")).trials
        except KeyError:  # the file is there, and the study not yet
            return []

    try:
        for begun in (True, False):
            deadline = time.monotonic() + 120
            while (len(trials()) < 2) if begun else any(trial.state == running for trial in trials()):
                assert time.monotonic() < deadline
                time.sleep(0.5)
            process.send_signal(end)
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def stand_in(monkeypatch):
    """A worker that fails where it has two trials, and else leaves a file once its pipe is closed."""
    Path("worker").write_text(
        '#!/bin/sh\ncase "$*" in\n  *"--n-trials 2") exit 3;;\n  *) cat; echo "$@" > ended;;\nesac\n'
    )
    Path("worker").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(Path("worker").absolute()))


def test_a_worker_that_fails_ends_the_others(stand_in):
    with pytest.raises(RuntimeError, match="ended with exit status 3, and the others were ended"):
        run_workers("sb3-sap optimize --seed 1 --n-jobs 2", 2, 3, ["--seed", "7"])
    told = "-m sb3_sap.zoo optimize --seed 1 --n-jobs 2 --seed 7 --n-jobs 1 --worker --n-trials 1"
    assert Path("ended").read_text().strip() == told


def test_ctrl_c_ends_workers(stand_in, monkeypatch):
    def interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_workers("sb3-sap optimize", 1, 1, [])
    assert Path("ended").exists()


def test_how_many_workers():
    assert [count_workers(n_jobs, 3) for n_jobs in (1, 2, 5)] == [1, 2, 3]
    assert count_workers(-1, 10_000) == os.cpu_count()
    for n_jobs in (0, -2):
        with pytest.raises(ValueError, match=f"`--n-jobs` must be at least 1, or -1 .* but is {n_jobs}"):
            count_workers(n_jobs, 3)


@pytest.mark.slow
@pytest.mark.parametrize("pruner", ["median", "halving"])
def test_nothing_is_pruned_before_every_trial_is_guided(pruner):
    """Every trial but the first would be pruned at once, because it is worse."""
    asked = []
    decide = optuna.pruners.MedianPruner.prune, optuna.pruners.SuccessiveHalvingPruner.prune
    for cls, original in zip(
        (optuna.pruners.MedianPruner, optuna.pruners.SuccessiveHalvingPruner), decide, strict=True
    ):

        def prune(self, study, trial, original=original):
            verdict = original(self, study, trial)
            asked.append((trial.last_step, verdict))
            return verdict

        cls.prune = prune
    try:
        flags = ["--n-trials", "3", "--n-startup-trials", "0", "--n-evaluations", "12", "--pruner", pruner]
        assert optimize("--storage", "study.log", "--no-optim-plots", *flags) == 0
    finally:
        optuna.pruners.MedianPruner.prune, optuna.pruners.SuccessiveHalvingPruner.prune = decide
    assert asked
    assert not [step for step, verdict in asked if verdict and step <= t_k_range(60)[1]]


def test_a_study_in_memory_leaves_a_report():
    assert optimize("-n", "20", "--n-trials", "2", "--no-optim-plots", "--optimization-log-path", "trials") == 0
    report = Path("logs/ddpg_ap") / f"report_{FOLDER}_study"
    assert {path.name for path in report.iterdir()} == {"report.md", "trials.csv"}
    assert "| 0 |" in (report / "report.md").read_text()
    assert Path("trials/trial_1/evaluations.npz").exists()


@pytest.mark.parametrize(
    ("seeds", "cells", "sentence"),
    [
        ({"default": 1, "trial 0": 1}, ["| 0.5 |  |", "| 0.75 | +0.25 |"], "One seed: no interval."),
        ({"default": 2, "trial 0": 1}, ["| 0.5 [0.5, 0.5] |", "| +0.25 |"], "Where there is one seed: no interval."),
        ({"default": 2, "trial 0": 2}, ["| 0.75 [0.75, 0.75] | +0.25 [+0.25, +0.25] |"], "95 %"),
    ],
)
def test_one_seed_has_no_interval(seeds, cells, sentence):
    study = optuna.create_study(study_name="study")
    study.tell(study.ask(), 0.9)
    scores = {"default": 0.5, "trial 0": 0.75}
    rows = [
        {"arm": arm, "seed": seed, "task": "t", "score": scores[arm]} for arm in seeds for seed in range(seeds[arm])
    ]
    text = summary(pd.DataFrame(rows), study, ["t"], "sb3-sap retest")
    assert sentence in text
    for cell in cells:
        assert cell in text


@pytest.mark.parametrize(("n_trials", "title"), [(1, "only 1 trial,"), (6, "only 6 trials,"), (20, "20 trials, the")])
def test_a_picture_of_few_trials_says_that_it_is_thin(n_trials, title):
    study = optuna.create_study(study_name="study", sampler=optuna.samplers.RandomSampler(seed=1))
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1) + trial.suggest_float("y", 0, 1), n_trials)
    [axis, *_] = contour(study, "x", "y", "value").axes
    assert axis.get_title().startswith(f"study: {title}")


def test_a_tuned_noise_of_none_is_loaded():
    study = optuna.create_study(study_name="study", storage=open_storage("study.log"), direction="maximize")
    space = {"using_her_replay_buffer": False, "her_kwargs": {}}
    study.enqueue_trial({"noise_type": None})
    trial = study.ask()
    HYPERPARAMS_SAMPLER["ddpg_ap"](trial, 1, 1, space)
    study.tell(trial, 1.0)
    assert trial.params["noise_type"] is None
    command = ["train", "--env", ENV, "-n", "10", "--eval-freq", "-1", "--trial-id", "0", "--storage", "study.log"]
    assert main([*command, "--study-name", "study"]) == 0


def test_a_study_of_something_else_is_not_continued(capsys):
    study = optuna.create_study(study_name="study", storage=open_storage("study.log"))
    study.set_user_attr("algo", "sac_ap")
    assert optimize("--storage", "study.log") == 1
    assert "is one of sac_ap on sap/LaneKeeping-v0, not of ddpg_ap" in capsys.readouterr().err


def test_retest_has_no_workers(capsys):
    command = ["retest", "--env", ENV, "-n", "10", "--n-jobs", "2", "--storage", "study.log", "--study-name", "study"]
    assert main(command) == 1
    assert "trains one model after the other: leave `--n-jobs` out" in capsys.readouterr().err


def test_help_tells_ours_and_theirs(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["optimize", "--help"])
    text = capsys.readouterr().out
    assert "--guidance-only" in text
    assert "--n-startup-trials" in text


@pytest.mark.slow
def test_the_options_of_an_entry_hold_for_evaluations_and_films():
    # Without them it has other observations. The share for validation is one that few examples cannot have.
    which = ["--algo", "sac_ap", "--env", "highway-fast-v0"]
    command = ["train", *which, "-n", "60", "--eval-freq", "40", "--eval-episodes", "1"]
    assert main([*command, "-params", "validation_fraction:0.05", "learning_starts:60"]) == 0
    assert main(["enjoy", *which, "--folder=logs", "--no-render", "-n", "20"]) == 0
    assert main(["record-video", *which, "-n", "20"]) == 0
    assert list(Path("logs").rglob("*.mp4"))


@pytest.mark.slow
def test_watching_filming_and_plotting(capsys):
    command = ["train", "--algo", "ddpg_ap", "--env", ENV, "-n", "100", "--eval-freq", "50", "--eval-episodes", "2"]
    for _ in range(2):  # rl_zoo3 compares several runs of several episodes, never one
        assert main([*command, "--save-freq", "50", "-tb", "boards", "-params", *QUICK]) == 0
    run = Path("logs/ddpg_ap") / f"{FOLDER}_1"
    assert list(Path("boards").rglob("events.*"))
    for which in (
        ["--load-checkpoint", "50"],
        ["--load-last-checkpoint"],
        ["--n-envs", "2", "--reward-log", "rewards"],
    ):
        assert main(["enjoy", "--env", ENV, "--no-render", "-n", "60", *which]) == 0
    assert main(["record-video", "--env", ENV, "-n", "20", "--exp-id", "1", "--load-best"]) == 0
    [film] = (run / "videos").glob("*.mp4")
    assert film.stat().st_size > 1_000
    assert (
        main(["plot", "train", "-a", "ddpg_ap", "-e", ENV, "-f", "logs", "-w", "2", "--save-figures", "figures"]) == 0
    )
    command = ["plot", "all", "-a", "ddpg_ap", "-e", FOLDER, "-f", "logs", "--no-million", "-o", "post"]
    assert main([*command, "--save-figures", "figures"]) == 0
    assert main(["plot", "file", "-i", "post", "--no-million", "--save-figures", "figures"]) == 0
    assert {path.name for path in Path("figures").iterdir()} >= {"train_1.png", "all_1.png"}
    capsys.readouterr()
    assert main(["enjoy", "--env", ENV, "--no-render", "--exp-id", "7"]) == 1
    assert "was not found" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("simulator", ["highway", "torcs"])
def test_a_study_maximises_the_score_of_laps(simulator):
    """The value of a trial is the mean of what `sb3-sap evaluate` says of the model that it saved."""
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


@pytest.mark.slow
@pytest.mark.parametrize("algo", [name for name in ALGORITHMS if name != "ddpg_ap"])
def test_every_algorithm_trains_and_tunes(algo):
    """The whole search space of each, and what it leaves is watched."""
    small = ["policy_kwargs:dict(net_arch=[8])", "batch_size:8", "buffer_size:500", "learning_starts:5"]
    env = "MountainCar-v0" if algo in ("dqn_ap", "qrdqn_ap") else ENV
    command = ["train", "--algo", algo, "--env", env, "-n", "30", "--eval-freq", "-1", "-params", *small]
    assert main(command) == 0
    assert main(["enjoy", "--algo", algo, "--env", env, "--no-render", "-n", "5"]) == 0
    command = ["optimize", "--algo", algo, "--env", env, "-n", "20", "--eval-episodes", "1", "--n-trials", "1"]
    assert main([*command, "--study-name", "whole", "--no-optim-plots"]) == 0
    assert "| 0 |" in (Path("logs") / algo / f"report_{env.replace('/', '-')}_whole" / "report.md").read_text()


@pytest.mark.parametrize("arguments", [["plot"], ["plot", "nothing"]])
def test_plot_says_what_it_draws(arguments, capsys):
    assert main(arguments) == 1
    assert "'study'" in capsys.readouterr().err
