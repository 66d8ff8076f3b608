"""Dispatches the runs of a grid that have no result yet, on this machine or a cluster, and stores each result."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import joblib
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_sap.benchmark.configurations import Configuration
from sb3_sap.benchmark.process import run_in_own_process, stop_all
from sb3_sap.benchmark.runs import Run
from sb3_sap.benchmark.store import read_result, snapshot_path, write_result
from sb3_sap.evaluation.laps import ENVIRONMENTS


def missing_runs(grid: dict[Configuration, list[Run]], folder: Path) -> list[tuple[str, Run]]:
    """Runs without a result, with the name of their configuration.

    Equal runs are listed once. They are sorted by seed, so that all configurations progress alike.
    """
    runs = {run.name: (configuration.name, run) for configuration, runs in grid.items() for run in runs}
    missing = [(name, run) for name, run in runs.values() if read_result(run, folder) is None]
    return sorted(missing, key=lambda pair: pair[1].seed)


def run_grid(
    grid: dict[Configuration, list[Run]],
    folder: Path,
    console: Console,
    jobs: int = 1,
    backend: str = "local",
    scheduler: str | None = None,
) -> int:
    """Makes the missing runs, and returns how many failed; a failure is reported, and the other runs continue.

    :param folder: of the results
    :param jobs: runs side by side on this machine; a cluster makes as many as it has threads
    :param scheduler: address of the Dask scheduler
    """
    missing = missing_runs(grid, folder)
    total = len({run.name for runs in grid.values() for run in runs})
    done = f"{total} runs, {total - len(missing)} of which are done already; results in {folder}/"
    console.print(done, markup=False, soft_wrap=True)
    failed = 0
    with _progress(console) as progress, _workers(backend, scheduler):
        task = progress.add_task("runs", total=len(missing))
        # Each run is one task, and no more are dispatched than can be made at once, so that Ctrl-C stops the rest.
        parallel = joblib.Parallel(
            n_jobs=-1 if backend == "dask" else jobs,
            batch_size=1,
            pre_dispatch="all" if backend == "dask" else "n_jobs",
            return_as="generator_unordered",
        )
        results = parallel(joblib.delayed(_numbered)(number, run, folder) for number, (_, run) in enumerate(missing))
        try:
            for number, result in results:
                name, run = missing[number]
                if "error" in result:
                    failed += 1
                    message = escape(f"{name}, seed {run.seed}: {result['error']}")
                    console.print(f"[red]failed[/] {message}", soft_wrap=True)
                else:
                    write_result(run, folder, result)
                    progress.update(task, description=_summary(name, run, result))
                    if not console.is_terminal:
                        console.print(_summary(name, run, result), soft_wrap=True)
                progress.advance(task)
        finally:
            stop_all()
    if failed:
        console.print(f"{failed} of {len(missing)} runs failed; the same command tries them again.")
    return failed


def _numbered(number: int, run: Run, folder: Path) -> tuple[int, dict[str, Any]]:
    return number, run_in_own_process(run, snapshot_path(run.name, folder))


@contextmanager
def _workers(backend: str, scheduler: str | None) -> Iterator[None]:
    if backend == "local":
        # Threads suffice, because each only waits for the process of its run.
        with joblib.parallel_config(backend="threading"):
            yield
        return
    if scheduler is None:
        raise ValueError("--backend dask needs --scheduler ADDRESS, such as tcp://127.0.0.1:8786.")
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise ValueError(f"--backend dask needs {error.name}: pip install 'sb3-sap[dask]'.") from error
    client = Client(scheduler, set_as_default=False)  # type: ignore[no-untyped-call]
    with client, joblib.parallel_config("dask", client=client):
        yield


def _summary(name: str, run: Run, result: dict[str, Any]) -> str:
    last = [row for row in result["laps"]["data"] if row[0] == run.checkpoints[-1]]
    score = sum(row[5] for row in last) / len(last)
    if run.simulator not in ENVIRONMENTS:
        return escape(f"{name}, seed {run.seed}: mean return {score:.4g}")
    done = sum(row[2] for row in last)
    return escape(f"{name}, seed {run.seed}: {done} of {len(last)} laps, S {score:.3f}")


def _progress(console: Console) -> Progress:
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.description}"), console=console, disable=not console.is_terminal)
