"""The commands `demo` and `evaluate`, and the errors of the command line."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time

import gymnasium as gym
import pandas as pd
import pytest
from PIL import Image
from rich.console import Console

from sb3_sap import DDPGAP
from sb3_sap.cli.demo import TrainingLog, results_table
from sb3_sap.cli.hub import EXTRAS
from sb3_sap.cli.main import main
from sb3_sap.evaluation.laps import LapResult


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--steps", "200", "--out", str(out), "--seed", "101"]) == 0
    return out


def test_demo_writes_its_files(demo):
    names = {path.name for path in demo.iterdir()}
    pictures = {"learning_curve.png", "predictor.png", "lap.gif"}
    assert names == {"model.zip", "predictor.pt", "run.json", "training.csv", "evaluation.json"} | pictures
    assert len(pd.read_csv(demo / "training.csv")) == 200
    rows = json.loads((demo / "evaluation.json").read_text())
    assert [row["track"] for row in rows] == ["eroad", "spring", "g-track-3", "ole-road-1"]
    assert all(0 <= row["covered"] <= 1 for row in rows)
    for name in pictures:
        with Image.open(demo / name) as image:
            assert image.getextrema() is not None
    assert DDPGAP.load(demo / "model.zip").noise_steps == 100


def test_evaluate_repeats_the_demos_laps(demo, tmp_path):
    out = tmp_path / "laps.json"
    assert main(["evaluate", str(demo / "model.zip"), "--tracks", "g-track-3", "--json", str(out)]) == 0
    [row] = json.loads(out.read_text())
    [before] = [row for row in json.loads((demo / "evaluation.json").read_text()) if row["track"] == "g-track-3"]
    assert row == before


@pytest.mark.parametrize("algo", ["ddpg", "ddpg_ce1", "ddpg_ce2", "ddpg_ap_ce2"])
def test_demo_runs_with_every_variant_of_ddpg(algo, tmp_path):
    out = tmp_path / "out"
    assert main(["demo", "--algo", algo, "--steps", "60", "--no-animation", "--out", str(out)]) == 0
    assert not (out / "lap.gif").exists()
    assert (out / "evaluation.json").exists()


@pytest.mark.slow
def test_saved_command_of_the_demo_gives_the_same_rows(demo, tmp_path):
    _, *words = shlex.split(json.loads((demo / "run.json").read_text())["command"])
    assert main([*words, "--out", str(tmp_path), "--no-animation"]) == 0
    assert (tmp_path / "training.csv").read_bytes() == (demo / "training.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demo", "--track", "wheel2"], "did you mean 'wheel-2'"),
        (["demo", "--preset", "papper"], "did you mean 'paper'"),
        (["evaluate", "nothing.zip"], "There is no model file nothing.zip"),
    ],
)
def test_errors_are_one_sentence(arguments, message, capsys):
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("sb3-sap: error: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [["demo", "--steps", "0"], ["demo", "--algo", "ppo"], ["nothing"], []])
def test_wrong_usage_exits_with_2(arguments):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)


@pytest.mark.parametrize("command", [[], ["demo"], ["evaluate"]])
def test_help_prints_the_usage(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        main([*command, "--help"])
    assert "usage: sb3-sap" in capsys.readouterr().out


@pytest.mark.slow
def test_ctrl_c_leaves_a_loadable_model(tmp_path):
    command = [sys.executable, "-m", "sb3_sap.cli.main", "demo", "--steps", "100000", "--out", str(tmp_path)]
    for name in EXTRAS:  # files of another model
        (tmp_path / name).write_text("old")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    assert "learns 100,000 steps" in process.stdout.readline()
    time.sleep(3)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in error
    assert DDPGAP.load(tmp_path / "model.zip").num_timesteps > 0
    taken = len(pd.read_csv(tmp_path / "training.csv"))
    assert taken > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.zip", "predictor.pt", "run.json", "training.csv"]
    command = json.loads((tmp_path / "run.json").read_text())["command"]
    assert command.endswith(f"# interrupted after {taken} steps")


def test_demo_table_shows_the_result_of_the_paper():
    console = Console(width=150, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(results_table([LapResult("eroad", False, 0.5, -10.0, -0.001, 7)], "ddpg", 3_000))
    text = console.export_text()
    assert "E-road" in text
    assert "50.0%" in text
    assert "17.6%" in text  # the paper's DDPG


def test_training_log_has_a_row_for_every_step():
    log = TrainingLog()
    DDPGAP("MlpPolicy", gym.make("sap/LaneKeeping-v0", laps=None), seed=0, learning_starts=10).learn(60, callback=log)
    table = pd.DataFrame(log.rows)
    assert list(table["step"]) == list(range(1, 61))
    assert (table.loc[table["off_track"], "reward"] == -200).all()
    assert table["off_track"].any()
