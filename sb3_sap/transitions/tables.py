"""Tables of a logger, CSV or Parquet, whose columns a mapping or a YAML file names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import yaml

from sb3_sap.common.arrays import rows_of
from sb3_sap.common.errors import nearest
from sb3_sap.common.yaml_text import read_yaml
from sb3_sap.transitions.batch import NAMES, Transitions, as_bool, readable, transitions_of

TABLES = (".csv", ".csv.gz", ".parquet")
#: What the columns hold, or the YAML file that says so.
Columns: TypeAlias = Mapping[str, Any] | str | Path
#: Rows that are read at a time.
ROWS = 20_000
FIELDS = (*NAMES, "episode")


def table_batches(path: Path, columns: Columns | None) -> Iterator[Transitions]:
    """Reads a table piece by piece.

    Each row is a step. Without columns of ``next_obs`` the next observation is that of the next row; the last step of
    an episode, or of the table, then has none and is left out. Episodes are told by ``dones``, or by a change of
    ``episode``.

    :param columns: for each array of a transition its columns: ``{"obs": ["position", "speed"], "actions": "pedal"}``
    """
    names = _columns(columns)
    last: Any = None  # the last row of the piece before, whose successor is in the next piece
    for frame in filter(len, _frames(path, names)):
        frame = frame if last is None else _pandas().concat([last, frame], ignore_index=True)
        last = frame.iloc[-1:]
        yield from _followed(frame, names)
    if last is not None and "next_obs" in names:
        # What follows the last row is not known, so that it counts as cut off there.
        arrays = _arrays(last, names)
        ends = {"dones": np.ones(1, bool), "truncated": np.ones(1, bool)} if "episode" in names else {}
        yield transitions_of(ends | arrays)


def _followed(frame: Any, names: Mapping[str, Any]) -> Iterator[Transitions]:
    """The transitions of all rows of a piece but the last, if there are any."""
    arrays, n = _arrays(frame, names), len(frame) - 1
    if n == 0:
        return
    after = rows_of(arrays["obs"], slice(1, None))
    arrays = {name: rows_of(array, slice(None, -1)) for name, array in arrays.items()}
    if "episode" in names:
        episode = frame[_all(names["episode"])].to_numpy()
        changes = (episode[1:] != episode[:-1]).any(axis=1)
        dones, cut = (as_bool(name, arrays.get(name, np.zeros(n))) for name in ("dones", "truncated"))
        arrays |= {"dones": dones | changes, "truncated": cut | (changes & ~dones)}
    if "next_obs" in names:
        yield transitions_of(arrays)
        return
    batch = transitions_of(arrays | {"next_obs": after})
    batch = batch if batch.dones is None else batch.rows(~batch.dones)
    if len(batch):
        yield batch


def _columns(columns: Columns | None) -> dict[str, Any]:
    if columns is None:
        raise ValueError(
            "A table needs `columns`, which say what its columns hold: "
            '{"obs": ["position", "speed"], "actions": ["pedal"], "rewards": "reward", "dones": "done"}, '
            "or the name of a YAML file with the same."
        )
    if isinstance(columns, (str, Path)):
        columns = _yaml(Path(columns))
    if not isinstance(columns, Mapping):
        raise ValueError(f"`columns` must map the arrays of a transition to columns, but is {columns!r}.")
    for name, value in columns.items():
        if name not in FIELDS:
            raise ValueError(f"`columns` has {name!r}, which no transition has: {nearest(name, FIELDS)}")
        if not _names(value):
            raise ValueError(
                f"`columns` must name the columns of {name!r} as text or a list of text, but has {value!r}."
            )
    for name in ("obs", "actions"):
        if name not in columns:
            raise ValueError(f"`columns` must name those of `{name}`.")
    return dict(columns)


def _yaml(path: Path) -> Any:
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    try:
        return read_yaml(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error


def _names(value: Any) -> bool:
    """Whether a value names columns: text, a list of text, or such a value for each key of an observation."""
    if isinstance(value, Mapping):
        return bool(value) and all(map(_names, value.values()))
    return isinstance(value, str) or (
        isinstance(value, list | tuple) and bool(value) and all(isinstance(one, str) for one in value)
    )


def _pandas() -> Any:
    import pandas

    return pandas


def _all(value: Any) -> list[str]:
    """The names of the columns of one array; of a ``Dict`` observation those of every key."""
    if isinstance(value, Mapping):
        return [name for one in value.values() for name in _all(one)]
    return [value] if isinstance(value, str) else list(value)


def _frames(path: Path, names: Mapping[str, Any]) -> Iterator[Any]:
    """The table's columns that are needed, as data frames."""
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    needed = list(dict.fromkeys(name for value in names.values() for name in _all(value)))
    if path.suffix == ".parquet":
        try:
            import pyarrow.parquet as pq
        except ModuleNotFoundError as error:
            raise ValueError(f"{path} is a Parquet table, which needs: pip install 'sb3-sap[logs]'.") from error
        with readable(path):
            file = pq.ParquetFile(path)
        with file:
            _check_columns(path, needed, file.schema_arrow.names)
            for batch in file.iter_batches(ROWS, columns=needed):
                yield batch.to_pandas()
        return
    pandas = _pandas()
    # Without `index_col` pandas takes the first column for an index where rows end with a comma.
    with readable(path):
        header = pandas.read_csv(path, nrows=0, index_col=False)
    _check_columns(path, needed, list(header.columns))
    with pandas.read_csv(path, usecols=needed, chunksize=ROWS, index_col=False) as chunks:
        yield from chunks


def _check_columns(path: Path, needed: list[str], known: list[str]) -> None:
    for name in needed:
        if name not in known:
            raise ValueError(f"{path} has no column {name!r}: {nearest(name, known)}")


def _arrays(frame: Any, names: Mapping[str, Any]) -> dict[str, Any]:
    """The arrays of all rows of a piece."""
    return {name: _array(frame, value, name) for name, value in names.items() if name != "episode"}


def _array(frame: Any, value: Any, name: str) -> Any:
    """(n,) of a single column, (n, k) of a list of columns, or such an array for each key of an observation."""
    if isinstance(value, Mapping):
        return {key: _array(frame, one, f"{name}[{key!r}]") for key, one in value.items()}
    found = frame[value if isinstance(value, str) else list(value)].to_numpy()
    if found.dtype.kind not in "biuf":
        try:
            found = found.astype(np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"`{name}` is not of numbers: the columns {value!r} hold {found.dtype}.") from None
    return found
