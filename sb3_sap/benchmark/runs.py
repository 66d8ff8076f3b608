"""One cell of the grid: everything that decides a training run, and the file in which its result is kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sb3_sap.benchmark.columns import Column
from sb3_sap.benchmark.learners import defaults_of, environment_of, settings_of
from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.benchmark.tasks import entry, evaluations
from sb3_sap.evaluation import ENVIRONMENTS
from sb3_sap.files import atomic_path

#: Training steps after which the actor drives a lap of each test track; and at the end of the training.
CHECKPOINTS = (100, 150, 200, 250, 350, 500, 750, 1000, 1500, 2000, 3000, 5000, 7500, 10000, 12500, 15000)
#: Options of the environment that belong to the task, so that the laps are driven with them too.
TASK_OPTIONS = ("speed", "control_step", "car")


@dataclass(frozen=True)
class Cell:
    """A training run. Two cells that are equal have the same result."""

    simulator: str  # of `ENVIRONMENTS`, or the id of an environment beyond lane keeping
    algo: str
    settings: dict[str, Any]  # constructor arguments
    defaults: dict[str, Any]  # the constructor's own values of the others
    training: dict[str, Any]  # options of the training environment
    steps: int
    seed: int
    tracks: list[str]
    checkpoints: list[int]

    @property
    def task(self) -> dict[str, Any]:
        """Options of the environments in which laps are driven."""
        return {name: value for name, value in self.training.items() if name in TASK_OPTIONS}

    def description(self) -> dict[str, Any]:
        """The cell as JSON holds it."""
        described: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return described

    def path(self, folder: Path) -> Path:
        """Where the result is kept; cells that differ in the seed alone have names that differ in the seed alone."""
        text = json.dumps(self.description() | {"seed": None, "defaults": None}, sort_keys=True)
        return folder / f"{self.algo}-{hashlib.sha256(text.encode()).hexdigest()[:10]}-seed{self.seed}.json"


def make_cell(column: Column, simulator: str, steps: int, seed: int, tracks: Iterable[str] = TEST_TRACKS) -> Cell:
    """The cell of a column and a seed, its settings resolved."""
    steps = column.of_run("steps", steps)
    settings = settings_of(column, simulator, steps)
    if simulator in ENVIRONMENTS:
        training = {"track": "wheel-2", "laps": None} | environment_of(column)
        if not column.learns:  # nothing is random either
            steps = seed = 0
        checkpoints = sorted({point for point in CHECKPOINTS if point < steps} | {steps})
    else:
        training = entry(column.algo, simulator).get("env_kwargs", {}) | environment_of(column)
        steps = steps if column.learns else 0
        checkpoints = evaluations(steps) if column.learns else [0]
    defaults = defaults_of(column, settings)
    return Cell(simulator, column.algo, settings, defaults, training, steps, seed, list(tracks), checkpoints)


def make_grid(
    columns: list[Column], simulator: str, steps: int, seeds: Iterable[int], tracks: Iterable[str] = TEST_TRACKS
) -> dict[Column, list[Cell]]:
    """The cells of every column."""
    seeds, tracks = list(seeds), list(tracks)
    return {
        column: [
            make_cell(column, simulator, steps, seed, tracks)
            for seed in (seeds[: column.of_run("seeds", len(seeds))] if column.algo != "linear" else [0])
        ]
        for column in columns
    }


def read_result(cell: Cell, folder: Path) -> dict[str, Any] | None:
    """The result of exactly this cell, if there is one."""
    path = cell.path(folder)
    try:
        result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ValueError(f"{path} is not the result of a cell ({error}): delete it, and it is made again.") from error
    return result if _same(result.get("cell", {}), cell.description()) else None


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two descriptions are of the same run: a parameter that only one constructor knows was not used."""
    shared = one.get("defaults", {}).keys() & other["defaults"].keys()
    changed = any(one["defaults"][name] != other["defaults"][name] for name in shared)
    return not changed and one | {"defaults": None} == other | {"defaults": None}


def write_result(cell: Cell, folder: Path, result: dict[str, Any]) -> None:
    """Writes the result as compact JSON; a reader never sees half of it."""
    with atomic_path(cell.path(folder)) as temporary:
        temporary.write_text(json.dumps(result, separators=(",", ":")) + "\n", encoding="utf-8")
