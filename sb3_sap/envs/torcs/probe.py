"""Trying out, in a process of its own, files that TORCS does not ship.

TORCS' parsers and physics follow what a file says without looking: a missing section or an odd number can crash them or
never let them return. What Debian ships is known to work; anything else is first driven in a child process.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import warnings
from collections.abc import Callable

#: Time after which a trial is given up, s.
TIME_LIMIT = 10
#: Exit status of a trial that came to its end; TORCS ends a process with 0 or 1.
SURVIVED = 42


def survives(trial: Callable[[], object], limit: int = TIME_LIMIT) -> str | None:
    """Runs a trial in a forked child and says how it failed, or None if it came to its end."""
    with warnings.catch_warnings():
        # Newer Pythons warn of forking beside threads; this child calls C code alone and leaves at once.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        _run(trial, limit)
    _, status = os.waitpid(child, 0)
    if not os.WIFSIGNALED(status):
        # Not its end either: an exception, or TORCS ending the process. It would happen here again.
        return None if os.WEXITSTATUS(status) == SURVIVED else "gives up"
    number = os.WTERMSIG(status)
    return "does not return" if number == signal.SIGALRM else f"crashes ({signal.Signals(number).name})"


def _run(trial: Callable[[], object], limit: int) -> None:
    status = 1
    try:
        faulthandler.disable()  # a crash is expected, and reported by the parent
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(limit)
        trial()
        status = SURVIVED
    finally:
        os._exit(status)
