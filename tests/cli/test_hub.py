"""`sb3-sap push-to-hub`, up to the call over the network."""

import json
import re
import shutil

import gymnasium as gym
import numpy as np
import pytest
from huggingface_hub import HfApi, ModelCard
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import Line, build

from sb3_sap import DDPGAP
from sb3_sap.cli.hub import find_trained, prepare
from sb3_sap.cli.main import main
from sb3_sap.evaluation.policies import load_policy

LAPS = [
    {"track": "eroad", "lap_done": True, "covered": 1.0, "total_reward": 1.0, "score": 0.9, "steps": 1},
    {"track": "spring", "lap_done": False, "covered": 0.5, "total_reward": 1.0, "score": 0.4, "steps": 1},
]
COMMAND = "sb3-sap demo --algo ddpg_ap --seed 3"


@pytest.fixture
def run(tmp_path):
    """The files of a demo."""
    folder = tmp_path / "demo_output"
    folder.mkdir()
    build(DDPGAP).save(folder / "model.zip")
    (folder / "run.json").write_text(json.dumps({"algo": "ddpg_ap", "simulator": "torcs", "command": COMMAND}))
    (folder / "evaluation.json").write_text(json.dumps(LAPS))
    (folder / "predictor.png").write_bytes(b"picture")
    return folder


@pytest.fixture
def uploads(monkeypatch):
    """Records what would be uploaded."""
    calls = []

    def create_repo(api, repo_id, **kwargs):
        calls.append(("create", repo_id))
        return type("Url", (str,), {"repo_id": repo_id})(repo_id)

    monkeypatch.setattr(HfApi, "create_repo", create_repo)
    monkeypatch.setattr(
        HfApi, "upload_file", lambda api, *, path_in_repo, repo_id, **kwargs: calls.append((path_in_repo, repo_id))
    )
    return calls


#: The format in which RL Zoo saves the arguments of a run.
SAVED = "!!python/object/apply:collections.OrderedDict\n- - - {}\n    - {}\n"


def push(*arguments):
    return main(["push-to-hub", *map(str, arguments)])


def test_all_files_are_uploaded_and_the_card_comes_last(run, uploads):
    assert push(run, "--repo-id", "me/car") == 0
    files = [name for name, repo_id in uploads if name != "create" and repo_id == "me/car"]
    model = "ddpg_ap-sap-TorcsLaneKeeping-v0.zip"
    assert files == [model, "predictor.png", "evaluation.json", "README.md"]
    assert (run / "hub" / model).read_bytes() == (run / "model.zip").read_bytes()


def test_predictor_is_uploaded_and_the_card_loads_it(run, uploads):
    build(DDPGAP).save_predictor(run / "predictor.pt")
    assert push(run, "--repo-id", "me/car") == 0
    assert ("predictor.pt", "me/car") in uploads
    card = (run / "hub" / "README.md").read_text(encoding="utf-8")
    assert 'PermissibilityPredictor.load(load_from_hub("me/car", "predictor.pt"))' in card


def test_card_has_results_command_and_usage(run, uploads):
    assert push(run, "--repo-id", "me/car", "--dry-run") == 0
    assert uploads == []
    card = ModelCard.load(run / "hub" / "README.md")
    [result] = card.data.eval_results
    assert (result.metric_type, result.metric_value) == ("mean_score", "0.650")
    assert card.data.library_name == "stable-baselines3"
    assert "sap/TorcsLaneKeeping-v0" in card.data.tags
    assert "| spring | 50.0% | 0.400 |" in card.text
    assert f"```\n{COMMAND}\n```" in card.text
    assert "![predictor](predictor.png)" in card.text
    assert "lap.gif" not in card.text  # the run wrote none
    assert 'DDPGAP.load(load_from_hub("me/car", "ddpg_ap-sap-TorcsLaneKeeping-v0.zip"))' in card.text


@pytest.fixture
def zoo_run(tmp_path):
    """The files of `sb3-sap train`."""
    from stable_baselines3 import DDPG

    folder = tmp_path / "Pendulum-v1_1"
    (folder / "Pendulum-v1").mkdir(parents=True)
    DDPG("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10).save(folder / "Pendulum-v1")
    (folder / "Pendulum-v1" / "command.txt").write_text(
        "/home/me/bin/python3 /home/me/bin/sb3-sap train --algo=ddpg --env Pendulum-v1 "
        "-params gamma:0.9 policy_kwargs:dict(net_arch=[4])"
    )
    (folder / "Pendulum-v1" / "args.yml").write_text(SAVED.format("env_kwargs", "null"))
    (folder / "Pendulum-v1" / "config.yml").write_text(SAVED.format("env_kwargs", "{g: 9.81, laps: null}"))
    return folder


def test_model_is_evaluated_with_the_env_kwargs_of_its_run(zoo_run):
    assert find_trained(zoo_run, None, None, None).env_kwargs == {"g": 9.81}
    (zoo_run / "Pendulum-v1" / "args.yml").write_text(SAVED.format("env_kwargs", "{g: 5}"))
    assert find_trained(zoo_run, None, None, None).env_kwargs == {"g": 5}
    (zoo_run / "Pendulum-v1" / "args.yml").write_text(SAVED.format("env_kwargs", "{gravity: 5}"))
    with pytest.raises(TypeError, match="gravity"):
        prepare(find_trained(zoo_run, None, None, None), "me/p", zoo_run / "hub", 1)


def test_run_of_rl_zoo_needs_no_further_arguments(zoo_run):
    assert push(zoo_run, "--repo-id", "me/p", "--dry-run", "--episodes", 1) == 0
    card = ModelCard.load(zoo_run / "hub" / "README.md")
    assert card.data.eval_results[0].dataset_name == "Pendulum-v1"
    command = "sb3-sap train --algo=ddpg --env Pendulum-v1 -params gamma:0.9 'policy_kwargs:dict(net_arch=[4])'"
    assert f"```\n{command}\n```" in card.text
    assert "/home/me" not in card.text
    assert (zoo_run / "hub" / "ddpg-Pendulum-v1.zip").is_file()


def test_best_model_of_an_rl_zoo_run_is_preferred(zoo_run):
    final = zoo_run / "Pendulum-v1.zip"
    shutil.copy(final, zoo_run / "best_model.zip")
    assert find_trained(zoo_run, None, None, None).model == zoo_run / "best_model.zip"
    final.unlink()
    assert push(zoo_run, "--repo-id", "me/p", "--dry-run", "--episodes", 1) == 0


def test_statistics_are_uploaded_and_the_card_loads_them_with_the_model(zoo_run, uploads, monkeypatch):
    statistics = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    statistics.obs_rms.mean = np.array([0.1, 0.2, 3.0])
    statistics.save(zoo_run / "Pendulum-v1" / "vecnormalize.pkl")
    assert push(zoo_run, "--repo-id", "me/p", "--episodes", 1) == 0
    assert [name for name, _ in uploads if name != "create"] == [
        "ddpg-Pendulum-v1.zip",
        "vecnormalize.pkl",
        "README.md",
    ]

    [use] = re.findall(r"```python\n(.*?)```", ModelCard.load(zoo_run / "hub" / "README.md").text, re.DOTALL)
    monkeypatch.setattr("huggingface_sb3.load_from_hub", lambda repo_id, filename: str(zoo_run / "hub" / filename))
    names = {}
    exec(use, names)
    model, env = names["model"], names["env"]
    assert model.get_vec_normalize_env() is env
    assert env.obs_rms.mean.tolist() == [0.1, 0.2, 3.0]
    assert not env.training
    assert env.get_attr("g") == [9.81]  # from the entry of the run
    obs = np.array([[0.5, 0.5, 2.0]], dtype=np.float32)
    expected = model.predict(env.normalize_obs(obs), deterministic=True)[0]
    loaded = load_policy(zoo_run / "Pendulum-v1.zip")
    assert np.array_equal(loaded.predict(obs, deterministic=True)[0], expected)


def test_missing_statistics_are_requested(run, uploads, capsys):
    build(DDPGAP, VecNormalize(DummyVecEnv([Line]))).learn(12).save(run / "model.zip")
    assert push(run, "--repo-id", "me/car") == 1
    assert "give them with `--vecnormalize FILE`" in capsys.readouterr().err
    assert uploads == []


def test_other_models_are_evaluated_with_the_given_arguments(tmp_path, uploads):
    from stable_baselines3 import DDPG

    DDPG("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10).save(tmp_path / "pendulum")
    named = ["--algo", "ddpg", "--env", "Pendulum-v1", "--command", "by hand", "--episodes", 2]
    assert push(tmp_path / "pendulum.zip", "--repo-id", "me/p", "--out", tmp_path / "out", *named) == 0
    [result] = ModelCard.load(tmp_path / "out" / "README.md").data.eval_results
    assert result.metric_type == "mean_reward"
    assert float(result.metric_value.split(" +/- ")[0]) < 0
    assert [name for name, _ in uploads if name != "create"] == ["ddpg-Pendulum-v1.zip", "README.md"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--repo-id", "no spaces please"], "Repo id"),
        (["--repo-id", "me/car", "--algo", "dppg"], "did you mean 'ddpg'"),
    ],
)
def test_invalid_arguments_are_refused(run, uploads, capsys, arguments, sentence):
    assert push(run, *arguments) == 1
    assert sentence in capsys.readouterr().err
    assert uploads == []


def test_unknown_environment_is_refused(run, uploads, capsys):
    (run / "evaluation.json").unlink()
    assert push(run, "--repo-id", "me/car", "--env", "Pendulum-v9") == 1
    assert "Pendulum" in capsys.readouterr().err


def test_missing_information_is_requested(run, uploads, capsys):
    (run / "run.json").unlink()
    assert push(run, "--repo-id", "me/car") == 1
    assert "add --algo and --env and --command" in capsys.readouterr().err
    assert push(run / "nothing.zip", "--repo-id", "me/car") == 1
    assert "There is no model" in capsys.readouterr().err
