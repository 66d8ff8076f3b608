"""The grid: nothing lost, nothing repeated, and a cell that fails hurts nobody else."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from rich.console import Console

from sb3_sap.benchmark import process, runner
from sb3_sap.benchmark.cells import make_grid, read_result
from sb3_sap.benchmark.columns import parse_columns
from sb3_sap.cli.main import main


def grid(*columns, seeds=2, steps=50):
    return make_grid(parse_columns(list(columns)), "highway", steps, range(seeds), ["g-track-3"])


def fake_result(cell):
    laps = [[point, track, True, 1.0, 1.0, 0.9, 10] for point in cell.checkpoints for track in cell.tracks]
    return {"cell": cell.description(), "laps": {"columns": [], "data": laps}}


@pytest.fixture
def console():
    return Console(width=200, record=True, file=open(os.devnull, "w"))


def run(cells, folder, console, monkeypatch, **options):
    """Runs the grid with cells that do nothing and returns (number of failures, cells that ran)."""
    ran = []

    def fake(cell):
        ran.append((cell.algo, cell.seed))
        return {"error": "ValueError: no"} if cell.settings.get("gamma") == 0.5 else fake_result(cell)

    monkeypatch.setattr(runner, "run_in_own_process", fake)
    return runner.run_grid(cells, folder, console, **options), ran


def test_only_what_is_missing_runs_seed_by_seed(tmp_path, console, monkeypatch):
    assert run(grid("ddpg", "sac"), tmp_path, console, monkeypatch) == (
        0,
        [("ddpg", 0), ("sac", 0), ("ddpg", 1), ("sac", 1)],
    )
    assert run(grid("ddpg", "sac"), tmp_path, console, monkeypatch) == (0, [])
    assert run(grid("sac", "td3", seeds=3), tmp_path, console, monkeypatch)[1] == [
        ("td3", 0),
        ("td3", 1),
        ("sac", 2),
        ("td3", 2),
    ]
    assert "4 cells, 4 of them done already" in console.export_text()
    assert len(list(tmp_path.iterdir())) == 8


def test_equal_cells_run_once(tmp_path, console, monkeypatch):
    assert run(
        grid("ddpg:default", "ddpg:paper[gamma=0.9]", "ddpg:paper", seeds=1), tmp_path, console, monkeypatch
    ) == (
        0,
        [("ddpg", 0), ("ddpg", 0)],
    )


def test_a_failing_cell_is_told_and_the_rest_goes_on(tmp_path, console, monkeypatch):
    failed, ran = run(grid("ddpg", "ddpg[gamma=0.5]", "sac"), tmp_path, console, monkeypatch, jobs=2)
    assert failed == 2
    assert len(ran) == 6
    text = console.export_text()
    assert "failed ddpg:default[gamma=0.5], seed 1: ValueError: no" in text
    assert "2 of 6 cells failed" in text
    assert len(list(tmp_path.glob("*.json"))) == 4


def test_exit_code_of_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "run_in_own_process", fake_result)
    arguments = ["benchmark", "run", "--simulator", "highway", "--steps", "20", "--seeds", "1", "--out", str(tmp_path)]
    assert main([*arguments, "--columns", "ddpg"]) == 0
    assert len(list((tmp_path / "highway-20" / "cells").glob("ddpg-*-seed0.json"))) == 1
    monkeypatch.setattr(runner, "run_in_own_process", lambda cell: {"error": "no"})
    assert main([*arguments, "--columns", "sac"]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--columns", "dpg:paper"], "did you mean 'ddpg'"),
        (["--columns", "ddpg:paper[x]"], "not of the form key=value"),
        (["--backend", "dask"], "--backend dask needs --scheduler"),
        (["--backend", "dask", "--scheduler", "tcp://127.0.0.1:1"], "tcp://127.0.0.1:1"),
    ],
)
def test_errors_are_one_sentence(arguments, message, tmp_path, capsys):
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        code = main(["benchmark", "run", "--steps", "20", "--out", str(tmp_path), *arguments])
    assert code == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_missing_library_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "sb3_sap.benchmark.runner")
    monkeypatch.setitem(sys.modules, "joblib", None)
    assert main(["benchmark", "run", "--out", str(tmp_path)]) == 1
    assert "needs joblib: pip install 'sb3-sap[benchmark]'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_process_that_fails_or_dies_says_so():
    [[unknown], [killed]] = grid("ddpg[env.trak=1]", "ddpg", seeds=1, steps=100_000).values()
    assert "unexpected keyword argument 'trak'" in process.run_in_own_process(unknown)["error"]
    import threading

    answer = {}
    thread = threading.Thread(target=lambda: answer.update(process.run_in_own_process(killed)))
    thread.start()
    while not process._running:
        time.sleep(0.01)
    [child] = process._running
    child.send_signal(signal.SIGSEGV)
    thread.join()
    assert "was killed by SIGSEGV" in answer["error"]


def command(out, *more):
    fixed = ["--simulator", "highway", "--columns", "ddpg", "ddpg_ap", "--steps", "40", "--seeds", "2"]
    fixed += ["--tracks", "g-track-3", "--out", str(out), *more]
    return [sys.executable, "-m", "sb3_sap.cli.main", "benchmark", "run", *fixed]


def wait_for(condition):
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def tables(folder):
    """What the cells say, without the times."""
    found = {}
    for path in folder.glob("*.json"):
        result = json.loads(path.read_text())
        found[path.name] = {name: result[name] for name in ("cell", "laps", "curve", "episodes")}
    return found


def living_children(pid):
    return subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()


@pytest.mark.slow
def test_killed_and_started_again(tmp_path):
    cells = tmp_path / "a" / "highway-40" / "cells"
    killed = subprocess.Popen(command(tmp_path / "a"), stdout=subprocess.DEVNULL)
    wait_for(lambda: len(list(cells.glob("*.json"))) >= 1)
    wait_for(lambda: living_children(killed.pid))
    [child] = living_children(killed.pid)
    killed.kill()
    killed.wait()
    before = {path: path.stat().st_mtime_ns for path in cells.glob("*.json")}
    assert 1 <= len(before) < 4
    wait_for(lambda: not os.path.exists(f"/proc/{child}"))  # the orphan ends by itself
    subprocess.run(command(tmp_path / "a"), check=True, stdout=subprocess.DEVNULL)
    assert {path: path.stat().st_mtime_ns for path in before} == before  # no cell ran twice
    subprocess.run(command(tmp_path / "b", "--jobs", "2"), check=True, stdout=subprocess.DEVNULL)
    assert len(tables(cells)) == 4
    assert tables(cells) == tables(tmp_path / "b" / "highway-40" / "cells")


@pytest.mark.slow
def test_ctrl_c_stops_the_cells_too(tmp_path):
    running = subprocess.Popen(
        command(tmp_path, "--steps", "100000"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        # A script's background jobs, and with them these tests, may have been told to ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    wait_for(lambda: living_children(running.pid))
    [child] = living_children(running.pid)
    running.send_signal(signal.SIGINT)
    _, error = running.communicate(timeout=60)
    assert running.returncode == 130
    assert error.decode() == "sb3-sap: interrupted; what was written so far is kept.\n"
    wait_for(lambda: not os.path.exists(f"/proc/{child}"))


@pytest.mark.slow
def test_a_cluster_gives_the_same_results(tmp_path):
    distributed = pytest.importorskip("distributed")
    local = ["benchmark", "run", *command(tmp_path / "a")[5:]]
    assert main(local) == 0
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        remote = ["benchmark", "run", *command(tmp_path / "b")[5:]]
        assert main([*remote, "--backend", "dask", "--scheduler", cluster.scheduler_address]) == 0
    assert len(tables(tmp_path / "b" / "highway-40" / "cells")) == 4
    assert tables(tmp_path / "a" / "highway-40" / "cells") == tables(tmp_path / "b" / "highway-40" / "cells")


def test_every_result_can_be_read_back(tmp_path, console, monkeypatch):
    cells = grid("ddpg")
    run(cells, tmp_path, console, monkeypatch)
    assert all(read_result(cell, tmp_path) == fake_result(cell) for column in cells.values() for cell in column)
