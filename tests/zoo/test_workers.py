"""Trials in parallel: workers that end, fail, or are interrupted."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from quick_runs import ENV, optimize, optuna

from sb3_sap.zoo.storages import open_storage
from sb3_sap.zoo.workers import count_workers, run_workers


@pytest.mark.slow
def test_two_workers_run_the_same_trials_as_one():
    flags = ["--n-trials", "3", "--n-startup-trials", "3", "--no-optim-plots"]
    assert optimize("--storage", "one.log", *flags) == 0
    assert optimize("--n-jobs", "2", *flags) == 0
    [file] = Path("logs").rglob("study.log")  # the default storage
    alone, together = (
        optuna.load_study(study_name="study", storage=open_storage(str(path))).trials for path in ("one.log", file)
    )
    assert [(t.params, t.user_attrs["seed"], t.value) for t in together] == [
        (t.params, t.user_attrs["seed"], t.value) for t in alone
    ]
    assert len({trial.user_attrs["worker"] for trial in together}) == 2


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_command_that_started_them(end):
    command = [sys.executable, "-m", "sb3_sap.zoo", "optimize", "--env", ENV, "-n", "100000", "--guidance-only"]
    command += ["--n-jobs", "2", "--storage", "study.log", "--study-name", "study"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    running = optuna.trial.TrialState.RUNNING

    def trials():
        if not Path("study.log").exists():
            return []
        try:
            return optuna.load_study(study_name="study", storage=open_storage("study.log")).trials
        except KeyError:  # the file exists, but not yet the study
            return []

    try:
        for begun in (True, False):
            deadline = time.monotonic() + 300  # s, on a machine that is busy with other tests
            while (len(trials()) < 2) if begun else any(trial.state == running for trial in trials()):
                assert time.monotonic() < deadline
                time.sleep(0.5)
            process.send_signal(end)
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def stand_in(monkeypatch):
    """Replaces a worker: it fails if it has two trials, and otherwise writes a file once its pipe is closed."""
    Path("worker").write_text(
        '#!/bin/sh\ncase "$*" in\n  *"--n-trials 2") exit 3;;\n  *) cat; echo "$@" > ended;;\nesac\n'
    )
    Path("worker").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(Path("worker").absolute()))


def test_failing_worker_ends_the_others(stand_in):
    with pytest.raises(RuntimeError, match="ended with exit status 3, and the others were ended"):
        run_workers("sb3-sap optimize --seed 1 --n-jobs 2", 2, 3, ["--seed", "7"])
    arguments = "-m sb3_sap.zoo optimize --seed 1 --n-jobs 2 --seed 7 --n-jobs 1 --worker --n-trials 1"
    assert Path("ended").read_text().strip() == arguments


def test_ctrl_c_ends_the_workers(stand_in, monkeypatch):
    def interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_workers("sb3-sap optimize", 1, 1, [])
    assert Path("ended").exists()


def test_workers_are_limited_by_n_jobs_and_trials():
    assert [count_workers(n_jobs, 3) for n_jobs in (1, 2, 5)] == [1, 2, 3]
    assert count_workers(-1, 10_000) == os.cpu_count()
    for n_jobs in (0, -2):
        with pytest.raises(ValueError, match=f"`--n-jobs` must be at least 1, or -1 .* but is {n_jobs}"):
            count_workers(n_jobs, 3)
