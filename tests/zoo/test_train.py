"""RL Zoo's commands `train`, `enjoy`, `record-video` and `plot`, as a user types them, with runs of few steps."""

import io
import os
import sys
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
import yaml
from quick_runs import ENV, FOLDER, QUICK, rl_zoo3
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap import DDPGAP
from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.cli.main import main
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.zoo.registration import small_buffers


class CountsEnds(BaseCallback):
    """A callback that YAML gives by its dotted name."""

    ends = 0

    def _on_step(self):
        return True

    def _on_training_end(self):
        type(self).ends += 1


def test_train_writes_the_files_of_rl_zoo_and_continues_a_saved_model():
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
    assert model._steps_of_earlier_learns == 60  # t_k counts the steps of all learns

    printed = io.StringIO()
    with redirect_stdout(printed):
        assert main(["enjoy", "--env", ENV, "--no-render", "-n", "30", "--exp-id", "1", "--load-best"]) == 0
    assert "best_model.zip" in printed.getvalue()


def test_default_entry_is_used_for_other_environments():
    command = ["train", "--algo", "sac_ap", "--env", "MountainCarContinuous-v0", "-n", "20", "--eval-freq", "-1"]
    command += ["--conf-file", "own.yml", "-params", "policy_kwargs:dict(net_arch=[8])"]
    settings = {"policy": "MlpPolicy", "n_timesteps": 20, "ap_function": "tests_ap.never", "callback": ["counts.Ends"]}
    Path("own.yml").write_text(yaml.safe_dump({"default": settings}))
    assert main(command) == 1  # there are no such modules
    settings |= {"ap_function": f"{__name__}.all_permissible", "callback": [f"{__name__}.CountsEnds"]}
    Path("own.yml").write_text(yaml.safe_dump({"default": settings}))
    CountsEnds.ends = 0
    assert main(command) == 0
    assert CountsEnds.ends == 1  # although rl_zoo3 calls the first callback twice


def test_modules_of_the_current_folder_are_found(monkeypatch):
    """As with `python -m sb3_sap.zoo`; the path of the console command has the folder of the command instead."""
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


def test_models_are_loaded_with_small_buffers_to_be_watched(tmp_path):
    DDPGAP("MlpPolicy", rl_zoo3.create_test_env(ENV, should_render=False, hyperparams={}), seed=1).save("model")
    with small_buffers():
        model = rl_zoo3.ALGOS["ddpg_ap"].load("model")
    assert (model.replay_buffer.buffer_size, model.buffer_size) == (1, 1)
    assert rl_zoo3.ALGOS["ddpg_ap"] is DDPGAP


@pytest.mark.slow
def test_env_kwargs_of_an_entry_apply_to_evaluations_and_videos():
    # Without env_kwargs it has other observations. A validation fraction that small is invalid for a small buffer.
    which = ["--algo", "sac_ap", "--env", "highway-fast-v0"]
    command = ["train", *which, "-n", "60", "--eval-freq", "40", "--eval-episodes", "1"]
    assert main([*command, "-params", "validation_fraction:0.05", "learning_starts:60"]) == 0
    assert main(["enjoy", *which, "--folder=logs", "--no-render", "-n", "20"]) == 0
    assert main(["record-video", *which, "-n", "20"]) == 0
    assert list(Path("logs").rglob("*.mp4"))


@pytest.mark.slow
def test_trained_models_are_watched_recorded_and_plotted(capsys):
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
@pytest.mark.parametrize("algo", [name for name in ALGORITHMS if name != "ddpg_ap"])
def test_every_algorithm_trains_and_tunes(algo):
    """With the whole search space of each; the saved model is watched."""
    small = ["policy_kwargs:dict(net_arch=[8])", "batch_size:8", "buffer_size:500", "learning_starts:5"]
    env = "MountainCar-v0" if algo in ("dqn_ap", "qrdqn_ap") else ENV
    command = ["train", "--algo", algo, "--env", env, "-n", "30", "--eval-freq", "-1", "-params", *small]
    assert main(command) == 0
    assert main(["enjoy", "--algo", algo, "--env", env, "--no-render", "-n", "5"]) == 0
    command = ["optimize", "--algo", algo, "--env", env, "-n", "20", "--eval-episodes", "1", "--n-trials", "1"]
    assert main([*command, "--study-name", "whole", "--no-optim-plots"]) == 0
    assert "| 0 |" in (Path("logs") / algo / f"report_{env.replace('/', '-')}_whole" / "report.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("algo", ON_POLICY_ALGORITHMS)
def test_every_on_policy_algorithm_trains_tunes_and_replays_a_trial(algo):
    which = ["--algo", algo, "--env", "MountainCar-v0"]
    label = "ap_function:'sb3_sap.tasks.mountain_car'"
    assert main(["train", *which, "-n", "64", "--eval-freq", "-1", "-params", label, "n_steps:32"]) == 0
    assert main(["enjoy", *which, "--no-render", "-n", "5"]) == 0
    study = ["--study-name", "whole", "--storage", "study.log"]
    command = ["train", *which, "-n", "32", "-optimize", "--n-trials", "2", "--eval-episodes", "1", "--no-optim-plots"]
    assert main([*command, "--n-evaluations", "1", *study, "-params", label]) == 0
    assert "| 1 |" in (Path("logs") / algo / "report_MountainCar-v0_whole" / "report.md").read_text()
    assert main(["train", *which, "-n", "32", "--eval-freq", "-1", *study, "--trial-id", "0", "-params", label]) == 0


@pytest.mark.parametrize("arguments", [["plot"], ["plot", "nothing"]])
def test_plot_without_a_known_kind_names_the_kinds(arguments, capsys):
    assert main(arguments) == 1
    assert "'study'" in capsys.readouterr().err
