"""Replaying what a robot logged inside the real race engine: the proof that this physics is TORCS' own, to the bit.

The same start and the same controls must give the same positions at every row. The files and the sequence are described
in ``tests/data/torcs/README.md``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_sap.envs.torcs.physics import TICK, Physics
from sb3_sap.envs.torcs.structures import PRESTART, RUNNING
from sb3_sap.envs.units import KMH

#: Columns of the controls that every trace has.
CONTROLS = ("steer_1", "accel_1")


def _angle(simulation: Physics) -> np.float32:
    # The robot's sensors keep 32-bit floats, and wrap them with a 64-bit π.
    angle = np.float32(simulation.heading) - np.float32(simulation.pose[2])
    turns = int(angle < -math.pi) - int(angle > math.pi)
    return np.float32(float(angle) + turns * 2 * math.pi)


def _slip(simulation: Physics) -> np.float32:
    front_right, front_left, rear_right, rear_left = map(np.float32, simulation.wheel_spins)
    return (rear_left + rear_right) - (front_left + front_right)


#: What is compared, by the column of a trace.
STATES: dict[str, Callable[[Physics], Any]] = {
    "angle_rad": _angle,
    "trackPos_1": lambda simulation: simulation.track_pos,
    "speedX_kmh": lambda simulation: np.float32(simulation.velocity[0]) * np.float32(KMH),
    "speedY_kmh": lambda simulation: np.float32(simulation.velocity[1]) * np.float32(KMH),
    "speedZ_kmh": lambda simulation: np.float32(simulation.velocity[2]) * np.float32(KMH),
    "slip_rad_s": _slip,
    "x_m": lambda simulation: simulation.pose[0],
    "y_m": lambda simulation: simulation.pose[1],
    "yaw_rad": lambda simulation: simulation.pose[2],
    "engine_rad_s": lambda simulation: simulation.engine_speed,
    "gear_1": lambda simulation: simulation.gear,
}
#: The columns that decide whether a row is identical; a trace must have them.
POSITION = ("x_m", "y_m")
#: Ticks between settling and the first row, with the brake on.
PRESTART_TICKS = 509


@dataclass(frozen=True)
class Comparison:
    """How a replay differs from its trace."""

    trace: str
    rows: int
    #: Rows whose x and y have the same bits.
    identical_rows: int
    all_columns_identical_rows: int
    #: The first row whose x or y differs.
    first_difference: int | None
    #: Largest absolute difference in each column.
    largest_deviation: dict[str, float]

    @property
    def identical(self) -> bool:
        """Whether x and y have the same bits at every row."""
        return self.identical_rows == self.rows


def replay(trace: Path, start_conditions: Path) -> Comparison:
    """Replays a trace from its start conditions and compares every row.

    :param trace: ``NAME.csv.gz``
    :param start_conditions: the JSON file whose ``traces`` has an entry NAME
    :raise ValueError: if a file or an entry is missing or is not what it should be
    """
    name = trace.name.partition(".")[0]
    conditions = _conditions(start_conditions, name)
    table = _table(trace)
    common, own = conditions["common"], conditions["trace"]
    simulation = Physics(
        Path(own["track"]).name,
        common["car"],
        common["skill_level"],
        common["fuel_factor"],
        common["damage_factor"],
    )
    try:
        simulated = _drive(simulation, table, _controls(table, common | own), own["grid"])
    finally:
        simulation.close()
    # Traces hold 32-bit floats; comparing as such compares bits, but for the sign of a zero.
    columns = [column for column in STATES if column in table]
    expected = table[columns].to_numpy(np.float32)
    simulated = simulated[:, [list(STATES).index(column) for column in columns]]
    same = expected == simulated
    same_position = same[:, [columns.index(column) for column in POSITION]].all(axis=1)
    different = np.flatnonzero(~same_position)
    deviation = np.abs(expected.astype(float) - simulated.astype(float)).max(axis=0)
    return Comparison(
        trace=name,
        rows=len(table),
        identical_rows=int(same_position.sum()),
        all_columns_identical_rows=int(same.all(axis=1).sum()),
        first_difference=int(different[0]) if len(different) else None,
        largest_deviation=dict(zip(columns, deviation.tolist(), strict=True)),
    )


def to_json(comparison: Comparison) -> str:
    """The comparison as JSON, keyed by the trace's name."""
    row = asdict(comparison) | {"identical": comparison.identical}
    return json.dumps({row.pop("trace"): row}, indent=2) + "\n"


def _controls(table: pd.DataFrame, conditions: dict[str, Any]) -> list[tuple[float, float, float, float, int]]:
    """Steer, accelerator, brake, clutch and gear of each row: a column of the trace, or a number for all rows."""
    commands = {"brake": 0, "clutch": 0, "gear": 1} | conditions.get("commands", {})
    columns = [table[column].to_numpy(np.float32).astype(float) for column in CONTROLS]
    for name in ("brake", "clutch", "gear"):
        command = commands[name]
        column = command.removeprefix("column ") if isinstance(command, str) else None
        values = table[column] if column in table else np.full(len(table), command, dtype=float)
        columns.append(np.asarray(values, dtype=np.float32).astype(float))
    return [(*row[:4], int(row[4])) for row in zip(*columns, strict=True)]


def _drive(
    simulation: Physics,
    table: pd.DataFrame,
    controls: list[tuple[float, float, float, float, int]],
    grid: dict[str, Any],
) -> np.ndarray[Any, Any]:
    """The simulated states, (rows, columns) float32."""
    width = simulation.road.segment(grid["start_pos_m"]).width
    to_middle = grid["to_right_m"] - width / 2
    simulation.place(grid["start_pos_m"], 2 * to_middle / width, height=grid["initial_height_m"])
    simulation.advance(PRESTART_TICKS, PRESTART)
    times = table["t_s"].to_numpy()
    states = np.empty((len(table), len(STATES)), dtype=np.float32)
    for i, control in enumerate(controls):
        states[i] = [read(simulation) for read in STATES.values()]
        if i + 1 == len(table):
            break
        simulation.control(*control)
        ticks = round((times[i + 1] - times[i]) / TICK)
        # The last row before the start holds 10 ticks of it, in which the engine zeroes the gear command, and then
        # runs on in neutral: the gear is not set again.
        waiting = min(max(round(-times[i] / TICK), 0), ticks)
        simulation.advance(waiting, PRESTART)
        simulation.advance(ticks - waiting, RUNNING)
    return states


def _conditions(path: Path, name: str) -> dict[str, Any]:
    try:
        conditions = json.loads(path.read_text(encoding="utf-8"))
        return {"common": conditions["common"], "trace": conditions["traces"][name]}
    except OSError as error:
        raise ValueError(
            f"There are no start conditions {path} ({error.strerror}): give their JSON file with `--start`."
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} must be JSON with `common` and an entry `traces.{name}`, named like the trace file: {error!r}."
        ) from error


def _table(path: Path) -> pd.DataFrame:
    needed = ("t_s", *CONTROLS, *POSITION)
    try:
        table = pd.read_csv(path)
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{path} is not a readable trace: {error}.") from error
    missing = [column for column in needed if column not in table]
    if missing or len(table) < 2:
        raise ValueError(f"{path} is not a trace: it needs rows and the columns {', '.join(missing or needed)}.")
    if not np.isfinite(table[list(needed)].to_numpy(float)).all():
        raise ValueError(f"{path} holds values that are no numbers.")
    return table
