"""Mistakes on the command line and in YAML are refused in one sentence; the shipped configurations are valid."""

import re
from pathlib import Path

import pytest
from quick_runs import ENV

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.cli.main import main
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.presets import load_config
from sb3_sap.zoo.configs import check_hyperparameters


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
def test_mistakes_on_the_command_line_get_one_sentence(arguments, sentence, capsys):
    environment = [] if "--env" in arguments else ["--env", ENV]
    assert main(["train", *environment, "-n", "10", *arguments]) == 1
    error = capsys.readouterr().err
    assert re.search(sentence if "|" in sentence else re.escape(sentence), error)
    assert error.startswith("sb3-sap: error: ")
    assert error.count("\n") == 1


def test_values_that_are_no_python_are_refused(capsys):
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
def test_invalid_yaml_files_are_refused(text, sentence, capsys):
    Path("own.yml").write_text(text)
    assert main(["train", "--env", ENV, "-n", "10", "--conf-file", "own.yml"]) == 1
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("ppo", {"normalize": True, "frame_stack": 2}),  # which stores observations as they are
        ("sac", {"normalize": False, "frame_stack": 2}),
        ("sac", {"normalize": True, "frame_stack": 1}),
    ],
)
def test_frames_can_be_stacked_without_normalised_observations(algo, settings):
    check_hyperparameters(algo, settings, "own.yml")


@pytest.mark.parametrize("algo", [*ALGORITHMS, *ON_POLICY_ALGORITHMS])
def test_shipped_configurations_are_valid(algo):
    for name, entry in load_config(algo).items():
        check_hyperparameters(algo, entry, name)
