"""A process of its own for each run, so that start-up counts, threads remain separate and a crash affects no other run.

The parent writes one line of JSON to the child's standard input and keeps it open; the child answers with one line on
its standard output. The child exits when its input ends, so that it never outlives a parent that was killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from sb3_sap.benchmark.runs import Run

#: One thread for each run: networks this small train no faster on two, and runs may be side by side.
SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PLATFORMS": "cpu",
}
_running: set[subprocess.Popen[str]] = set()


def run_in_own_process(run: Run, snapshot: Path | None = None) -> dict[str, Any]:
    """The result of a run, or ``{"error": sentence}``; it never raises an exception, so that other runs continue.

    :param snapshot: where the training is saved every few minutes, and from where it continues after a kill
    """
    process = subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | SINGLE_THREADED,
        start_new_session=True,  # Ctrl-C reaches the parent alone, which then stops the children
    )
    request = {"run": run.description(), "began": time.monotonic(), "snapshot": snapshot and str(snapshot)}
    _running.add(process)
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    errors: list[str] = []
    reader = threading.Thread(target=lambda stream: errors.extend(stream), args=(process.stderr,), daemon=True)
    reader.start()
    try:
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
        process.stdin.close()
        code = process.wait()
        reader.join()
    except BrokenPipeError:
        answer, code = "", process.wait()
    finally:
        _running.discard(process)
        if process.poll() is None:
            process.kill()
    if answer.endswith("\n"):
        result: dict[str, Any] = json.loads(answer)
        return result
    died = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    last = f": {errors[-1].strip()}" if errors else ""
    return {"error": f"its process {died}{last}"}


def stop_all() -> None:
    """Kills the child processes of all runs in progress."""
    for process in list(_running):
        process.kill()


def main() -> None:
    """Entry point of the child process."""
    # The answer gets a descriptor of its own, because libraries may print to standard output.
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    snapshot = request["snapshot"] and Path(request["snapshot"])
    answer.write(json.dumps(_result(Run(**request["run"]), request["began"], snapshot)) + "\n")
    answer.flush()
    os._exit(0)  # without waiting for libraries to shut down


def _result(run: Run, began: float, snapshot: Path | None) -> dict[str, Any]:
    import torch as th

    from sb3_sap.benchmark.provenance import provenance
    from sb3_sap.benchmark.training import train_and_evaluate

    th.set_num_threads(1)
    try:
        tables = train_and_evaluate(run, began, snapshot)
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return {"run": run.description(), "made": provenance(), **tables}


def _exit_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
