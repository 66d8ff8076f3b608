"""Racing in the benchmark: laps from the grid, and their page."""

import argparse
import math

import pandas as pd
import pytest

from sb3_sap.benchmark.commands import command_line
from sb3_sap.benchmark.configurations import parse_configuration, parse_configurations
from sb3_sap.benchmark.recorder import CURVE_COLUMNS, EPISODE_COLUMNS, TIME_COLUMNS
from sb3_sap.benchmark.reports.races import races, steps_to_laps
from sb3_sap.benchmark.reports.results import collect
from sb3_sap.benchmark.runs import make_grid, make_run
from sb3_sap.benchmark.store import write_result
from sb3_sap.benchmark.training import RACE_COLUMNS, train_and_evaluate
from sb3_sap.cli.main import main
from sb3_sap.evaluation.racing import RACING

MADE = {"versions": {"python": "3.11"}, "machine": "a machine", "date": "2020-01-02", "revision": "abc"}
TRACKS = ["wheel-2", "eroad", "g-track-3"]


def laps_of(done):
    """A table of laps: which tracks were lapped, by checkpoint."""
    rows = [("a", 0, point, track, track in tracks) for point, tracks in done.items() for track in TRACKS]
    return pd.DataFrame(rows, columns=["configuration", "seed", "checkpoint", "track", "lap_done"])


@pytest.mark.parametrize(
    ("done", "steps"),
    [
        ({10: ["wheel-2"], 20: TRACKS, 30: []}, 20),
        ({10: ["eroad", "g-track-3"], 20: ["wheel-2", "eroad"]}, math.inf),
    ],
)
def test_the_goal_is_the_track_of_the_training_and_two_others_at_once(done, steps):
    assert steps_to_laps(laps_of(done)).tolist() == [steps]


def test_of_one_track_the_goal_is_a_lap():
    laps = laps_of({10: ["eroad"], 20: ["wheel-2"]})
    assert steps_to_laps(laps[laps["track"] == "wheel-2"]).tolist() == [20]


def test_the_page_counts_laps_and_tells_their_median_time(tmp_path):
    grid = make_grid(parse_configurations(["sac_ap:base+loss", "scripted"]), RACING, 40, range(3), TRACKS)
    assert [len(runs) for runs in grid.values()] == [3, 1]
    for runs in grid.values():
        for run in runs:
            laps, learns = [], run.algo != "scripted"
            for point in run.checkpoints:
                done = (point >= 20 and run.seed < 2) or not learns
                time = 100.0 + run.seed if done else None
                laps += [
                    [point, track, done, 1.0 if done else 0.25, time, 1.0 if done else 0.25, 10] for track in TRACKS
                ]
            tables = {
                "laps": (RACE_COLUMNS, laps),
                "times": (TIME_COLUMNS, [[point, point, point, point / 100] for point in run.checkpoints] * learns),
                "curve": (CURVE_COLUMNS, [[40, 1.0, 0.8, 0.7, 10]] * learns),
                "episodes": (EPISODE_COLUMNS, [[20, 20, 1.0, "off track"], [40, 20, 1.0, "still"]] * learns),
            }
            tables = {name: {"columns": columns, "data": data} for name, (columns, data) in tables.items()}
            write_result(run, tmp_path, {"run": run.description(), "made": MADE, **tables})
    races(collect(grid, tmp_path, RACING, 40), tmp_path, "command")
    page = (tmp_path / "races.md").read_text(encoding="utf-8").splitlines()
    header, learned, scripted = ([cell.strip() for cell in page[number].split("|")[1:-1]] for number in (4, 6, 7))
    learned, scripted = dict(zip(header, learned, strict=True)), dict(zip(header, scripted, strict=True))
    assert learned["wheel-2"] == "2 of 3, 100.5 s"
    assert learned["steps until the goal"] == "20 (2)"
    assert learned["part of a lap after 10"] == "0.25 [0.25, 0.25]"
    assert (learned["steps"], learned["part of a lap at the end"]) == ("40", "0.75 [0.25, 1.00]")
    assert (learned["mistakes"], learned["episodes lost"]) == ("25.0%", "1")
    assert (scripted["eroad"], scripted["steps until the goal"]) == ("1 of 1, 100.0 s", "")
    assert {path.name for path in tmp_path.glob("races*")} == {"races.md", "races.svg", "races.csv"}


def test_the_scripted_driver_is_a_run_of_the_benchmark():
    run = make_run(parse_configuration("scripted"), RACING, 100, 0, ["g-track-3"])
    [lap] = train_and_evaluate(run, 0.0)["laps"]["data"]
    found = dict(zip(RACE_COLUMNS, lap, strict=True))
    assert found["lap_done"]
    assert 80 < found["lap_time"] < 100


@pytest.mark.parametrize(
    "arguments", [["sap/TorcsRacing-v0", "--report", "returns"], ["Pendulum-v1", "--report", "races"]]
)
def test_the_report_of_races_is_for_racing(arguments, capsys):
    assert main(["benchmark", "task", *arguments]) != 0
    assert "The report 'races' is for sap/TorcsRacing-v0" in " ".join(capsys.readouterr().err.split())


def test_tracks_are_for_racing(capsys):
    assert main(["benchmark", "task", "Pendulum-v1", "--tracks", "spring"]) != 0
    assert "--tracks is for sap/TorcsRacing-v0" in " ".join(capsys.readouterr().err.split())


def test_the_tracks_of_a_race_can_be_chosen(tmp_path):
    command = ["benchmark", "task", RACING, "--tracks", "g-track-3", "--out", str(tmp_path)]
    assert main([*command, "--configurations", "scripted"]) == 0
    folder = tmp_path / "TorcsRacing-v0-g-track-3"
    assert pd.read_csv(folder / "races.csv")["track"].tolist() == ["g-track-3"]
    page = (folder / "races.md").read_text(encoding="utf-8")
    assert "*Steps until the goal* (a lap of g-track-3)" in page
    assert "--configurations scripted --tracks g-track-3`" in page


@pytest.mark.parametrize("tracks", [["eroad", "spring", "g-track-3", "ole-road-1"], ["wheel-2"]])
def test_the_command_of_a_page_names_the_tracks(tracks):
    options = argparse.Namespace(
        simulator=RACING, steps=40, seeds=1, first_seed=0, configurations=["scripted"], tracks=tracks
    )
    assert command_line(options, "races").endswith(f"--tracks {' '.join(tracks)}")


@pytest.mark.slow
def test_a_command_trains_races_and_writes_the_page(tmp_path):
    command = ["benchmark", "task", RACING, "--steps", "40", "--seeds", "1", "--out", str(tmp_path)]
    assert main([*command, "--configurations", "sac_ap:base+loss"]) == 0
    folder = tmp_path / "TorcsRacing-v0"
    table = pd.read_csv(folder / "races.csv")
    assert set(table["track"]) == {"wheel-2", "eroad", "spring", "g-track-3", "ole-road-1"}
    assert set(table["checkpoint"][table["track"] == "spring"]) == {40}  # whose lap is long
    assert f"`sb3-sap benchmark task {RACING} --steps 40 --seeds 1 --configurations sac_ap:base+loss`" in (
        folder / "races.md"
    ).read_text(encoding="utf-8")
