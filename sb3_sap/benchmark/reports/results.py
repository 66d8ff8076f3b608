"""The results of a grid as tidy tables, with one row for every lap, time, point of a curve or episode."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_sap.benchmark.configurations import Configuration
from sb3_sap.benchmark.runs import Run
from sb3_sap.benchmark.store import read_result

TABLES = ("laps", "times", "curve", "episodes")


class NoResults(ValueError):
    """There is nothing to report."""


@dataclass
class Results:
    """The results that were found of a grid. Every table begins with the columns ``configuration`` and ``seed``."""

    simulator: str
    steps: int
    configurations: list[Configuration]  # those with at least one result
    missing: dict[str, int]  # number of runs without a result, by name of the configuration
    laps: pd.DataFrame
    times: pd.DataFrame
    curve: pd.DataFrame
    episodes: pd.DataFrame
    made: list[dict[str, Any]]  # provenance of every run

    @property
    def names(self) -> list[str]:
        """Names of the configurations, in order."""
        return [configuration.name for configuration in self.configurations]

    def final_laps(self) -> pd.DataFrame:
        """The laps after the whole training."""
        last = self.laps.groupby("configuration")["checkpoint"].transform("max")
        return self.laps[self.laps["checkpoint"] == last]

    def only(self, names: list[str]) -> Results:
        """The results of some of the configurations."""
        kept = {table: _of(getattr(self, table), names) for table in TABLES}
        configurations = [configuration for configuration in self.configurations if configuration.name in names]
        missing = {name: number for name, number in self.missing.items() if name in names}
        return Results(self.simulator, self.steps, configurations, missing, made=self.made, **kept)

    def renamed(self, old: str, new: str) -> Results:
        """The same results, as if those with a preset had another one."""
        names = {each.name: replace(each, preset=new).name for each in self.configurations if each.preset == old}
        tables = {table: getattr(self, table).replace({"configuration": names}) for table in TABLES}
        configurations = [replace(each, preset=new) if each.preset == old else each for each in self.configurations]
        return replace(self, configurations=configurations, **tables)


def collect(grid: dict[Configuration, list[Run]], folder: Path, simulator: str, steps: int) -> Results:
    """Reads the results of a grid.

    :param folder: of the results
    :raise NoResults: if there is none
    """
    parts: dict[str, list[pd.DataFrame]] = {table: [] for table in TABLES}
    made, missing, with_results = [], {}, []
    for configuration, runs in grid.items():
        found = [(run, result) for run in runs if (result := read_result(run, folder)) is not None]
        if found:
            with_results.append(configuration)
        if len(found) < len(runs):
            missing[configuration.name] = len(runs) - len(found)
        for run, result in found:
            made.append(result["made"])
            for table, rows in parts.items():
                frame = pd.DataFrame(result[table]["data"], columns=result[table]["columns"])
                frame.insert(0, "configuration", configuration.name)
                frame.insert(1, "seed", run.seed)
                rows.append(frame)
    if not made:
        raise NoResults(
            f"there are no results of these configurations in {folder}: make them with `sb3-sap benchmark run`."
        )
    tables = {table: _joined(frames) for table, frames in parts.items()}
    return Results(simulator, steps, with_results, missing, made=made, **tables)


def _joined(frames: list[pd.DataFrame]) -> pd.DataFrame:
    filled = [frame for frame in frames if len(frame)]
    return pd.concat(filled or frames[:1], ignore_index=True)


def _of(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    return table[table["configuration"].isin(names)].reset_index(drop=True)
