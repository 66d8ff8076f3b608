"""A grid loses no run and repeats none, and a run that fails affects no other."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from rich.console import Console

from sb3_sap.benchmark import dispatch, process
from sb3_sap.benchmark.configurations import parse_configurations
from sb3_sap.benchmark.runs import make_grid
from sb3_sap.benchmark.store import read_result
from sb3_sap.cli.main import main


def grid(*configurations, seeds=2, steps=50):
    return make_grid(parse_configurations(list(configurations)), "highway", steps, range(seeds), ["g-track-3"])


def fake_result(run):
    laps = [[point, track, True, 1.0, 1.0, 0.9, 10] for point in run.checkpoints for track in run.tracks]
    return {"run": run.description(), "laps": {"columns": [], "data": laps}}


@pytest.fixture
def console():
    return Console(width=200, record=True, file=open(os.devnull, "w"))


def make(runs, folder, console, monkeypatch, **options):
    """Makes a grid of runs that do nothing and returns the number of failures and the runs that were made."""
    made = []

    def fake(run, snapshot):
        made.append((run.algo, run.seed))
        return {"error": "ValueError: no"} if run.settings.get("gamma") == 0.5 else fake_result(run)

    monkeypatch.setattr(dispatch, "run_in_own_process", fake)
    return dispatch.run_grid(runs, folder, console, **options), made


def test_only_missing_runs_are_made_seed_by_seed(tmp_path, console, monkeypatch):
    assert make(grid("ddpg", "sac"), tmp_path, console, monkeypatch) == (
        0,
        [("ddpg", 0), ("sac", 0), ("ddpg", 1), ("sac", 1)],
    )
    assert make(grid("ddpg", "sac"), tmp_path, console, monkeypatch) == (0, [])
    assert make(grid("sac", "td3", seeds=3), tmp_path, console, monkeypatch)[1] == [
        ("td3", 0),
        ("td3", 1),
        ("sac", 2),
        ("td3", 2),
    ]
    assert "4 runs, 4 of which are done already" in console.export_text()
    assert len(list((tmp_path / "runs").iterdir())) == 8


def test_equal_runs_are_made_once(tmp_path, console, monkeypatch):
    assert make(
        grid("ddpg:default", "ddpg:paper[gamma=0.9]", "ddpg:paper", seeds=1), tmp_path, console, monkeypatch
    ) == (
        0,
        [("ddpg", 0), ("ddpg", 0)],
    )


def test_a_failing_run_is_reported_and_the_others_continue(tmp_path, console, monkeypatch):
    failed, made = make(grid("ddpg", "ddpg[gamma=0.5]", "sac"), tmp_path, console, monkeypatch, jobs=2)
    assert failed == 2
    assert len(made) == 6
    text = console.export_text()
    assert "failed ddpg:default[gamma=0.5], seed 1: ValueError: no" in text
    assert "2 of 6 runs failed" in text
    assert len(list((tmp_path / "runs").glob("*.json"))) == 4


def test_exit_code_of_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(dispatch, "run_in_own_process", lambda run, snapshot: fake_result(run))
    arguments = ["benchmark", "run", "--simulator", "highway", "--steps", "20", "--seeds", "1", "--out", str(tmp_path)]
    assert main([*arguments, "--configurations", "ddpg"]) == 0
    assert len(list((tmp_path / "highway-20" / "runs").glob("ddpg-*-seed0.json"))) == 1
    monkeypatch.setattr(dispatch, "run_in_own_process", lambda run, snapshot: {"error": "no"})
    assert main([*arguments, "--configurations", "sac"]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--configurations", "dpg:paper"], "did you mean 'ddpg'"),
        (["--configurations", "ddpg:paper[x]"], "not of the form key=value"),
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
    monkeypatch.delitem(sys.modules, "sb3_sap.benchmark.dispatch")
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
    fixed = ["--simulator", "highway", "--configurations", "ddpg", "ddpg_ap", "--steps", "40", "--seeds", "2"]
    fixed += ["--tracks", "g-track-3", "--out", str(out), *more]
    return [sys.executable, "-m", "sb3_sap.cli.main", "benchmark", "run", *fixed]


def wait_for(condition):
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def tables(folder):
    """The results of the runs without their times."""
    found = {}
    for path in folder.glob("*.json"):
        result = json.loads(path.read_text())
        found[path.name] = {name: result[name] for name in ("run", "laps", "curve", "episodes")}
    return found


def living_children(pid):
    return subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()


@pytest.mark.slow
def test_killed_and_started_again(tmp_path):
    runs = tmp_path / "a" / "highway-40" / "runs"
    killed = subprocess.Popen(command(tmp_path / "a"), stdout=subprocess.DEVNULL)
    wait_for(lambda: len(list(runs.glob("*.json"))) >= 1)
    wait_for(lambda: living_children(killed.pid))
    [child] = living_children(killed.pid)
    killed.kill()
    killed.wait()
    before = {path: path.stat().st_mtime_ns for path in runs.glob("*.json")}
    assert 1 <= len(before) < 4
    wait_for(lambda: not os.path.exists(f"/proc/{child}"))  # the orphan exits by itself
    subprocess.run(command(tmp_path / "a"), check=True, stdout=subprocess.DEVNULL)
    assert {path: path.stat().st_mtime_ns for path in before} == before  # no run was made twice
    subprocess.run(command(tmp_path / "b", "--jobs", "2"), check=True, stdout=subprocess.DEVNULL)
    assert len(tables(runs)) == 4
    assert tables(runs) == tables(tmp_path / "b" / "highway-40" / "runs")


@pytest.mark.slow
def test_ctrl_c_stops_the_runs_too(tmp_path):
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
    assert len(tables(tmp_path / "b" / "highway-40" / "runs")) == 4
    assert tables(tmp_path / "a" / "highway-40" / "runs") == tables(tmp_path / "b" / "highway-40" / "runs")


def test_every_result_can_be_read_back(tmp_path, console, monkeypatch):
    runs = grid("ddpg")
    make(runs, tmp_path, console, monkeypatch)
    assert [read_result(run, tmp_path) == fake_result(run) for run in runs[next(iter(runs))]] == [True, True]
