"""Several workers on one study: each goes on until all trials are finished, and one command may start them all.

Workers are processes: threads would share the global random generators, and no trial could be repeated.
"""

from __future__ import annotations

import _thread
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import optuna
from optuna.trial import TrialState

from sb3_sap.zoo.storages import FINISHED, LIVE, reap

#: Time between two looks at the trials of other workers, s.
POLL = 2.0
#: Time that an interrupted worker may take to give up its trial, s.
PATIENCE = 10.0


class SurplusTrial(Exception):
    """Another worker began the last trial of the study at the same moment."""


def work_until(study: optuna.Study, objective: Callable[[optuna.Trial], float], max_total_trials: int) -> None:
    """Runs trials until that many are finished, by whichever worker; those of workers that died are run again."""
    reported = False
    while True:
        reap(study)
        trials = study.get_trials(deepcopy=False, states=LIVE)
        if sum(trial.state in FINISHED for trial in trials) >= max_total_trials:
            return
        waiting = any(trial.state == TrialState.WAITING for trial in trials)
        if waiting or len(trials) < max_total_trials:
            study.optimize(objective, n_trials=1, catch=(SurplusTrial,), gc_after_trial=True)
            continue
        if not reported:
            reported = True
            running = [trial.number for trial in trials if trial.state == TrialState.RUNNING]
            print(f"Waiting for trials {running} of other workers, in case one of them dies.")
        time.sleep(POLL)


def count_workers(n_jobs: int, n_trials: int) -> int:
    """The number of workers for ``--n-jobs``: at most one per trial, and for -1 one per processor."""
    if n_jobs < 1 and n_jobs != -1:
        raise ValueError(f"`--n-jobs` must be at least 1, or -1 for a worker of each processor, but is {n_jobs}.")
    return max(1, min(n_trials, n_jobs if n_jobs > 0 else os.cpu_count() or 1))


def run_workers(command: str, n_workers: int, n_trials: int, flags: list[str]) -> None:
    """Runs the command in that many processes, which share the trials, until all have ended.

    Each holds the end of a pipe, and ends when this process closes the other one or is gone, however it died.

    :param command: as typed, ``sb3-sap optimize …``
    :param flags: appended, so that they replace what was typed
    :raise RuntimeError: if a worker fails, after the others were ended
    """
    call = [sys.executable, "-m", "sb3_sap.zoo", *shlex.split(command)[1:], *flags, "--n-jobs", "1", "--worker"]
    share, rest = divmod(n_trials, n_workers)
    workers = [
        subprocess.Popen(
            [*call, "--n-trials", str(share + (number < rest))],
            stdin=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for this process, which then ends the workers
        )
        for number in range(n_workers)
    ]
    try:
        while any(worker.poll() is None for worker in workers):
            _refuse_failure(workers)
            time.sleep(0.1)
        _refuse_failure(workers)
    finally:
        for worker in workers:
            worker.stdin.close()  # type: ignore[union-attr]
        for worker in workers:
            worker.wait()


def _refuse_failure(workers: list[subprocess.Popen[bytes]]) -> None:
    failed = [worker.returncode for worker in workers if worker.returncode]
    if failed:
        raise RuntimeError(
            f"A worker of `--n-jobs` ended with exit status {failed[0]}, and the others were ended, too: correct what "
            "it says above, and give the command again, on the same `--storage` to keep what is finished."
        )


def end_with_parent() -> None:
    """Interrupts this worker, as Ctrl-C does, when the command that started it is gone."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs lack

    def watch() -> None:
        while os.read(0, 1):
            pass
        _thread.interrupt_main()
        time.sleep(PATIENCE)
        os._exit(1)  # the interrupt was lost in a destructor

    threading.Thread(target=watch, daemon=True).start()
