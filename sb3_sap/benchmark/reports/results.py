"""The results of a grid as tidy tables, one row for every lap, point of a curve or episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_sap.benchmark.cells import Cell, read_result
from sb3_sap.benchmark.columns import Column

TABLES = ("laps", "times", "curve", "episodes")


class NoResults(ValueError):
    """Nothing to report."""


@dataclass
class Results:
    """What was found of a grid. Every table begins with the columns ``column`` and ``seed``."""

    simulator: str
    steps: int
    columns: list[Column]  # those of which there is at least one run
    missing: dict[str, int]  # runs that there are not, by column
    laps: pd.DataFrame
    times: pd.DataFrame
    curve: pd.DataFrame
    episodes: pd.DataFrame
    made: list[dict[str, Any]]  # provenance of every run

    @property
    def names(self) -> list[str]:
        """The columns' names, in order."""
        return [column.name for column in self.columns]

    def final_laps(self) -> pd.DataFrame:
        """The laps after the whole training."""
        last = self.laps.groupby("column")["checkpoint"].transform("max")
        return self.laps[self.laps["checkpoint"] == last]

    def only(self, names: list[str]) -> Results:
        """The same with some of the columns."""
        kept = {table: _of(getattr(self, table), names) for table in TABLES}
        columns = [column for column in self.columns if column.name in names]
        missing = {name: number for name, number in self.missing.items() if name in names}
        return Results(self.simulator, self.steps, columns, missing, made=self.made, **kept)


def collect(grid: dict[Column, list[Cell]], folder: Path, simulator: str, steps: int) -> Results:
    """Reads the results that there are."""
    parts: dict[str, list[pd.DataFrame]] = {table: [] for table in TABLES}
    made, missing, found_columns = [], {}, []
    for column, cells in grid.items():
        found = [(cell, result) for cell in cells if (result := read_result(cell, folder)) is not None]
        if found:
            found_columns.append(column)
        if len(found) < len(cells):
            missing[column.name] = len(cells) - len(found)
        for cell, result in found:
            made.append(result["made"])
            for table, rows in parts.items():
                frame = pd.DataFrame(result[table]["data"], columns=result[table]["columns"])
                frame.insert(0, "column", column.name)
                frame.insert(1, "seed", cell.seed)
                rows.append(frame)
    if not made:
        raise NoResults(f"there are no results of these columns in {folder}: make them with `sb3-sap benchmark run`.")
    tables = {table: _joined(frames) for table, frames in parts.items()}
    return Results(simulator, steps, found_columns, missing, made=made, **tables)


def _joined(frames: list[pd.DataFrame]) -> pd.DataFrame:
    filled = [frame for frame in frames if len(frame)]
    return pd.concat(filled or frames[:1], ignore_index=True)


def _of(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    return table[table["column"].isin(names)].reset_index(drop=True)
