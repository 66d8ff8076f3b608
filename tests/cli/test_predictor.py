"""``sb3-sap predictor``, as a user types it."""

import gymnasium as gym
import numpy as np
import pytest
import yaml

from sb3_sap import DDPGAP, PermissibilityPredictor
from sb3_sap.cli.main import main

ENV, LABELS = "MountainCarContinuous-v0", "sb3_sap.tasks.mountain_car_continuous"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A CSV of random driving, and the file that names its columns."""
    folder = tmp_path_factory.mktemp("log")
    env, rows = gym.make(ENV), ["run,position,velocity,force,reward"]
    env.action_space.seed(0)
    for run in range(3):
        obs, _ = env.reset(seed=run)
        for _ in range(400):
            force = env.action_space.sample()
            next_obs, reward, *_ = env.step(force)
            rows.append(f"{run},{obs[0]},{obs[1]},{force[0]},{reward}")
            obs = next_obs
    (folder / "log.csv").write_text("\n".join(rows), encoding="utf-8")
    columns = {"obs": ["position", "velocity"], "actions": "force", "rewards": "reward", "episode": "run"}
    (folder / "columns.yml").write_text(yaml.safe_dump(columns), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def fitted(log):
    out = log / "predictor.pt"
    named = ["--env", ENV, "--ap-function", LABELS, "--columns", str(log / "columns.yml")]
    assert main(["predictor", "fit", str(log / "log.csv"), *named, "--out", str(out), "--net-arch", "32"]) == 0
    return out


def test_fit_writes_a_predictor_that_an_algorithm_begins_with(fitted):
    predictor = PermissibilityPredictor.load(fitted)
    assert predictor.arguments["net_arch"] == [32]
    obs = np.array([[-0.5, 0.02], [-0.5, 0.02]], np.float32)
    with_motion, against = predictor.probabilities(obs, np.array([[0.9], [-0.9]]))
    assert with_motion > 0.5 > against
    model = DDPGAP("MlpPolicy", ENV, predictor=fitted, buffer_size=100)
    assert model.validation_accuracy > 0.8


def test_evaluate_tells_accuracy_and_calibration(log, fitted, capsys):
    named = ["--env", ENV, "--ap-function", LABELS, "--columns", str(log / "columns.yml")]
    assert main(["predictor", "evaluate", str(fitted), str(log / "log.csv"), *named]) == 0
    output = capsys.readouterr().out
    assert "1,197 labelled" in output
    assert "Balanced accuracy 0." in output
    assert "calibration error" in output


def test_show(fitted, capsys):
    assert main(["predictor", "show", str(fitted)]) == 0
    output = capsys.readouterr().out
    assert "balanced accuracy" in output
    assert "Box(-1.0, 1.0, (1,), float32)" in output


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fit", "nowhere.csv", "--env", ENV], "needs `columns`"),
        (["show", "nowhere.pt"], "There is no file nowhere.pt"),
        (["fit", "log.csv", "--env", ENV, "--columns", "columns.yml"], "The transitions have no labels"),
    ],
)
def test_what_is_wrong_is_one_sentence(words, sentence, log, monkeypatch, capsys):
    monkeypatch.chdir(log)
    assert main(["predictor", *words]) == 1
    assert sentence in capsys.readouterr().err


def test_demo_begins_with_a_predictor(tmp_path):
    for folder, more in (("one", []), ("two", ["--predictor", str(tmp_path / "one" / "predictor.pt")])):
        words = ["demo", "--steps", "30", "--no-animation", "--out", str(tmp_path / folder), *more]
        assert main(words) == 0
    assert f"--predictor {tmp_path / 'one' / 'predictor.pt'}" in (tmp_path / "two" / "run.json").read_text()
