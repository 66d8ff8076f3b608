"""Four workers, each in its own process, run one study on a PostgreSQL server on loopback."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pytest

optuna = pytest.importorskip("optuna", reason="RL Zoo is not installed: pip install sb3-sap[zoo]")
pytest.importorskip("rl_zoo3", reason="RL Zoo is not installed: pip install sb3-sap[zoo]")
pytest.importorskip("psycopg", reason="no driver of PostgreSQL is installed: pip install sb3-sap[postgres]")

BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin")) or [Path(shutil.which("initdb") or "/nowhere").parent]
WORKERS = 4
TRIALS = 10
HEARTBEAT = 5  # s

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (BINARIES[-1] / "initdb").exists(), reason="PostgreSQL is not installed: apt-get install postgresql"
    ),
    pytest.mark.skipif(os.getuid() == 0 and not shutil.which("runuser"), reason="root, without runuser"),
]


@pytest.fixture(scope="module")
def server():
    """The address of a database server that lives as long as the tests; it listens on loopback alone."""
    folder = Path(tempfile.mkdtemp(prefix="sap-postgres-"))
    # initdb refuses root.
    as_owner = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
    if as_owner:
        shutil.chown(folder, "postgres", "postgres")
    data = folder / "data"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def call(*command):
        subprocess.run([*as_owner, *map(str, command)], check=True, cwd="/", stdout=subprocess.DEVNULL, timeout=120)

    try:
        call(BINARIES[-1] / "initdb", "-D", data, "-U", "sap", "--auth=trust", "--no-sync")
        options = f"-c listen_addresses=127.0.0.1 -p {port} -k {folder} -c fsync=off"
        call(BINARIES[-1] / "pg_ctl", "-D", data, "-l", folder / "log", "-w", "-o", options, "start")
        yield f"postgresql+psycopg://sap@127.0.0.1:{port}/postgres"
        call(BINARIES[-1] / "pg_ctl", "-D", data, "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def workers():
    """Filled by the test, which none of them outlives."""
    started = []
    yield started
    for worker in started:
        worker.kill()
        worker.wait()


def start_workers(workers, server, study, folder):
    command = [sys.executable, "-m", "sb3_sap.zoo", "optimize", "--env", "sap/LaneKeeping-v0", "--guidance-only"]
    command += ["-n", "150", "--eval-episodes", "1", "--max-total-trials", str(TRIALS), "--n-startup-trials", "3"]
    command += ["--storage", server, "--study-name", study, "--heartbeat", str(HEARTBEAT), "--no-optim-plots", "--uuid"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    for number in range(WORKERS):
        with (folder / f"{number}.log").open("w") as log:
            workers.append(subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=environment))


def finish(workers, folder):
    for number, worker in enumerate(workers):
        assert worker.wait(timeout=400) == 0, (folder / f"{number}.log").read_text()


def reported_finished(folder):
    """How often workers reported that a trial has finished."""
    logs = "".join(path.read_text() for path in folder.glob("*.log"))
    return Counter(map(int, re.findall(r"Trial (\d+) (?:finished|pruned)", logs)))


def check(study, folder):
    finished = [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]
    assert len(finished) == TRIALS
    assert reported_finished(folder) == Counter(trial.number for trial in finished)  # none is run twice
    assert len({trial.user_attrs["seed"] for trial in finished}) == TRIALS
    assert len({tuple(trial.params.values()) for trial in finished}) == TRIALS
    assert not [trial for trial in study.trials if trial.state.name in ("RUNNING", "WAITING")]


def test_four_workers_finish_one_study(server, workers, tmp_path):
    start_workers(workers, server, "four", tmp_path)
    finish(workers, tmp_path)
    study = optuna.load_study(study_name="four", storage=server)
    check(study, tmp_path)
    assert len({trial.user_attrs["worker"] for trial in study.trials if "worker" in trial.user_attrs}) > 1


def test_trial_of_a_killed_worker_is_run_by_another(server, workers, tmp_path):
    start_workers(workers, server, "killed", tmp_path)
    victim = trial = None
    deadline = time.monotonic() + 300
    while trial is None:
        assert time.monotonic() < deadline, "no worker ever began a trial"
        try:
            running = optuna.load_study(study_name="killed", storage=server).get_trials(
                states=(optuna.trial.TrialState.RUNNING,)
            )
        except KeyError:
            running = []  # the study does not exist yet
        for candidate in running:
            owner = candidate.user_attrs.get("worker", ":0").split(":")[1]
            victim = next((worker for worker in workers if str(worker.pid) == owner), None)
            if victim is not None and "t_k" in candidate.params:
                trial = candidate
                victim.send_signal(signal.SIGKILL)
                break
        time.sleep(0.05)
    assert victim.wait(timeout=60) == -signal.SIGKILL
    finish([worker for worker in workers if worker is not victim], tmp_path)

    study = optuna.load_study(study_name="killed", storage=server)
    check(study, tmp_path)
    assert study.trials[trial.number].state.name == "FAIL"
    [again] = [t for t in study.trials if t.number != trial.number and t.params == trial.params]
    assert again.state.name in ("COMPLETE", "PRUNED")
    assert again.user_attrs["seed"] == trial.user_attrs["seed"]
    assert again.user_attrs["worker"] != trial.user_attrs["worker"]
