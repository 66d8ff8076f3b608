"""Replays of traces that TORCS recorded, which must be identical to the bit, and other figures of TORCS itself."""

import json
from pathlib import Path

import pandas as pd
import pytest

from sb3_sap.cli.main import main
from sb3_sap.envs import TRACKS, get_track
from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.torcs.replay import replay
from sb3_sap.envs.torcs.simulator import race_grid

TRACES = Path(__file__).parents[2] / "data" / "torcs"


START = TRACES / "start_conditions.json"


@pytest.mark.parametrize("name", ["wheel-2", "eroad"])
def test_replays_are_identical_to_the_bit(torcs, name):
    found = replay(TRACES / f"{name}.csv.gz", START)
    assert found.identical_rows == found.all_columns_identical_rows == found.rows >= 3000
    assert found.first_difference is None
    assert set(found.largest_deviation.values()) == {0.0}


def test_replay_takes_commands_from_columns(torcs, tmp_path):
    table = pd.read_csv(TRACES / "eroad.csv.gz", dtype=str).assign(commanded=1)
    table.to_csv(tmp_path / "eroad.csv.gz", index=False)
    conditions = json.loads(START.read_text())
    conditions["traces"]["eroad"]["commands"] = {"gear": "column commanded"}
    (tmp_path / "start.json").write_text(json.dumps(conditions))
    assert replay(tmp_path / "eroad.csv.gz", tmp_path / "start.json").identical
    table.assign(commanded=2).to_csv(tmp_path / "eroad.csv.gz", index=False)
    assert not replay(tmp_path / "eroad.csv.gz", tmp_path / "start.json").identical


def test_replay_detects_a_changed_condition(torcs, tmp_path):
    conditions = json.loads(START.read_text())
    conditions["common"]["skill_level"] = 3
    (tmp_path / "start.json").write_text(json.dumps(conditions))
    found = replay(TRACES / "eroad.csv.gz", tmp_path / "start.json")
    assert not found.identical
    assert found.first_difference is not None
    assert found.largest_deviation["x_m"] > 0.01


def test_replay_command_writes_its_result_and_reports_missing_files(torcs, tmp_path, capsys):
    out = tmp_path / "out.json"
    trace = str(TRACES / "eroad.csv.gz")
    assert main(["torcs", "replay", trace, "--start", str(START), "--json", str(out)]) == 0
    assert json.loads(out.read_text())["eroad"]["identical_rows"] == 4000
    assert main(["torcs", "replay", trace, "--start", str(tmp_path / "none.json")]) == 1
    assert "There are no start conditions" in capsys.readouterr().err
    assert main(["torcs", "replay", str(START), "--start", str(START)]) == 1


def test_race_grid_is_that_of_the_race_engine(torcs):
    for name, conditions in json.loads(START.read_text())["traces"].items():
        grid = race_grid(torcs.track(name), conditions["track_length_m"])
        assert grid["distance"] == pytest.approx(conditions["grid"]["start_pos_m"])
        assert grid["track_pos"] == pytest.approx(conditions["grid"]["trackPos"])
        simulation = Physics(name)
        simulation.place(**grid)
        settled = conditions["settled"]
        assert simulation.pose == pytest.approx((settled["x_m"], settled["y_m"], settled["yaw_rad"]), abs=1e-4)
        simulation.close()


@pytest.mark.parametrize("name", list(TRACKS))
def test_shipped_tracks_have_length_and_width_of_torcs(torcs, name):
    simulation = Physics(name)
    assert simulation.length == pytest.approx(get_track(name).length, abs=0.06)
    assert simulation.road.segments[0].width == get_track(name).width
    simulation.close()
