"""Runs the cells of a grid that have no result yet, here or on a cluster, and keeps each result as it comes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import joblib
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_sap.benchmark.cells import Cell, read_result, write_result
from sb3_sap.benchmark.columns import Column
from sb3_sap.benchmark.process import run_in_own_process, stop_all
from sb3_sap.evaluation import ENVIRONMENTS


def missing_cells(grid: dict[Column, list[Cell]], folder: Path) -> list[tuple[str, Cell]]:
    """(column, cell) of those without a result, seed by seed, so that every column grows alike; each cell once."""
    cells = {cell.path(folder): (column.name, cell) for column, cells in grid.items() for cell in cells}
    missing = [(name, cell) for name, cell in cells.values() if read_result(cell, folder) is None]
    return sorted(missing, key=lambda pair: pair[1].seed)


def run_grid(
    grid: dict[Column, list[Cell]],
    folder: Path,
    console: Console,
    jobs: int = 1,
    backend: str = "local",
    scheduler: str | None = None,
) -> int:
    """Runs what is missing and returns how many cells failed; those are told, and the others go on.

    :param folder: of the cells' results
    :param jobs: cells side by side on this machine; a cluster runs as many as it has threads
    :param scheduler: address of the Dask scheduler
    """
    missing = missing_cells(grid, folder)
    total = len({cell.path(folder) for cells in grid.values() for cell in cells})
    done = f"{total} cells, {total - len(missing)} of them done already; results in {folder}/"
    console.print(done, markup=False, soft_wrap=True)
    failed = 0
    with _progress(console) as progress, _workers(backend, scheduler):
        task = progress.add_task("cells", total=len(missing))
        # One task for each cell, and no more handed out than run: what was not begun can still be interrupted.
        parallel = joblib.Parallel(
            n_jobs=-1 if backend == "dask" else jobs,
            batch_size=1,
            pre_dispatch="all" if backend == "dask" else "n_jobs",
            return_as="generator_unordered",
        )
        results = parallel(joblib.delayed(_run)(number, cell) for number, (_, cell) in enumerate(missing))
        try:
            for number, result in results:
                name, cell = missing[number]
                if "error" in result:
                    failed += 1
                    told = escape(f"{name}, seed {cell.seed}: {result['error']}")
                    console.print(f"[red]failed[/] {told}", soft_wrap=True)
                else:
                    write_result(cell, folder, result)
                    progress.update(task, description=_told(name, cell, result))
                    if not console.is_terminal:
                        console.print(_told(name, cell, result), soft_wrap=True)
                progress.advance(task)
        finally:
            stop_all()
    if failed:
        console.print(f"{failed} of {len(missing)} cells failed; the command run again tries them anew.")
    return failed


def _run(number: int, cell: Cell) -> tuple[int, dict[str, Any]]:
    return number, run_in_own_process(cell)


@contextmanager
def _workers(backend: str, scheduler: str | None) -> Iterator[None]:
    if backend == "local":
        # Threads are enough, since each only waits for the process of its cell.
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


def _told(name: str, cell: Cell, result: dict[str, Any]) -> str:
    last = [row for row in result["laps"]["data"] if row[0] == cell.checkpoints[-1]]
    score = sum(row[5] for row in last) / len(last)
    if cell.simulator not in ENVIRONMENTS:
        return escape(f"{name}, seed {cell.seed}: mean return {score:.4g}")
    done = sum(row[2] for row in last)
    return escape(f"{name}, seed {cell.seed}: {done} of {len(last)} laps, S {score:.3f}")


def _progress(console: Console) -> Progress:
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.description}"), console=console, disable=not console.is_terminal)
