"""The command `demo --task racing`."""

import json

import pandas as pd
import pytest
from PIL import Image

from sb3_sap import TQCAP
from sb3_sap.cli import racing_demo
from sb3_sap.cli.main import main
from sb3_sap.envs.torcs.installation import TorcsNotFoundError, find_installation


@pytest.fixture
def short(monkeypatch):
    try:
        find_installation()
    except TorcsNotFoundError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(racing_demo, "LOGGED", 2_000)
    monkeypatch.setattr(racing_demo, "TAUGHT", 50)


@pytest.mark.slow
def test_racing_demo_leaves_laps_and_their_picture(short, tmp_path):
    assert main(["demo", "--task", "racing", "--seed", "101", "--steps", "20", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "model.zip",
        "predictor.pt",
        "run.json",
        "laps.csv",
        "lap.png",
    }
    laps = pd.read_csv(tmp_path / "laps.csv")
    assert set(laps["driver"]) == {"TQCAP", "TQCAP after 20 steps", "scripted"}
    scripted = laps[laps["driver"] == "scripted"]
    assert scripted["progress_m"].iloc[-1] == pytest.approx(2843.1, abs=0.1)  # the whole lap
    with Image.open(tmp_path / "lap.png") as image:
        assert image.getextrema() is not None
    assert TQCAP.load(tmp_path / "model.zip").num_timesteps == 20
    command = json.loads((tmp_path / "run.json").read_text())["command"]
    assert command == "sb3-sap demo --task racing --algo tqc_ap --steps 20 --seed 101 --track g-track-3"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo", "ddpg_ap"], "trains sac_ap or tqc_ap, got 'ddpg_ap'"),
        (["--simulator", "torcs"], "has no --simulator: leave it out"),
        (["--no-animation"], "has no --animation: leave it out"),
    ],
)
def test_racing_demo_refuses_what_it_does_not_have(arguments, message, capsys):
    assert main(["demo", "--task", "racing", *arguments]) == 1
    printed = "".join(capsys.readouterr())
    assert message in printed.replace("\n", " ")
