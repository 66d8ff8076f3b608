"""A process for each cell, so that start-up counts, threads stay apart and a crash hurts nobody else.

The parent writes one line of JSON to the child's standard input and keeps that open; the child answers with one line
on its standard output. When the input ends, the parent is gone, however it died, and the child goes too.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from sb3_sap.benchmark.cells import Cell

#: One thread each: networks this small run no faster on two, and cells run side by side.
SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PLATFORMS": "cpu",
}
_running: set[subprocess.Popen[str]] = set()


def run_in_own_process(cell: Cell) -> dict[str, Any]:
    """The result of a cell, or ``{"error": sentence}``; never an exception, so that other cells go on."""
    process = subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | SINGLE_THREADED,
        start_new_session=True,  # Ctrl-C is for the parent, who then stops the children
    )
    _running.add(process)
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    errors: list[str] = []
    reader = threading.Thread(target=lambda stream: errors.extend(stream), args=(process.stderr,), daemon=True)
    reader.start()
    try:
        process.stdin.write(json.dumps({"cell": cell.description(), "began": time.monotonic()}) + "\n")
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
    """Ends the cells that run in this process' children."""
    for process in list(_running):
        process.kill()


def main() -> None:
    """The child's side."""
    # What libraries print must not end up in the answer.
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    answer.write(json.dumps(_result(Cell(**request["cell"]), request["began"])) + "\n")
    answer.flush()
    os._exit(0)  # the answer is out, and what libraries do when they are torn down must not be waited for


def _result(cell: Cell, began: float) -> dict[str, Any]:
    import torch as th

    from sb3_sap.benchmark.provenance import provenance
    from sb3_sap.benchmark.training import run_cell

    th.set_num_threads(1)
    try:
        tables = run_cell(cell, began)
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return {"cell": cell.description(), "made": provenance(), **tables}


def _leave_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
