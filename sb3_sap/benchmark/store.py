"""The results of runs on disk: a file for each run as it ends, and a compressed archive into which they are packed.

A folder of results holds ``runs/NAME.json`` for each run, one line of JSON, and ``runs.jsonl.xz``: the same lines,
sorted by name. A file takes precedence over the archive, so that a run that is made again replaces the old result.
"""

from __future__ import annotations

import json
import lzma
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from sb3_sap.benchmark.runs import Run, name_of
from sb3_sap.common.files import atomic_path

ARCHIVE = "runs.jsonl.xz"


def run_path(name: str, folder: Path) -> Path:
    """Where the result of a run is written as the run ends."""
    return folder / "runs" / f"{name}.json"


def snapshot_path(name: str, folder: Path) -> Path:
    """Where a run in progress is saved; the file is deleted as the run ends."""
    return (folder / "runs" / f"{name}.snapshot").absolute()


def read_result(run: Run, folder: Path) -> dict[str, Any] | None:
    """The result of exactly this run, or None if there is none.

    :param folder: folder of the grid
    :raise ValueError: if the file or the archive is damaged
    """
    name = run.name
    path = run_path(name, folder)
    try:
        line = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        # The order matters: `pack` writes the archive before it deletes the files.
        path, archived = folder / ARCHIVE, read_archive(folder)
        if name not in archived:
            return None
        line = archived[name]
    result = _parsed(line, path)
    return result if _same(result["run"], run.description()) else None


def write_result(run: Run, folder: Path, result: dict[str, Any]) -> None:
    """Writes the result of a run as one line of compact JSON, atomically."""
    with atomic_path(run_path(run.name, folder)) as temporary:
        temporary.write_text(json.dumps(result, separators=(",", ":")) + "\n", encoding="utf-8", newline="\n")


def pack(folder: Path) -> tuple[int, int]:
    """Moves the results of single files into the archive of their folder.

    The same runs give the same bytes. The archive is complete on disk before the first file is deleted, so that
    nothing is lost if the process is killed; packing again then deletes the remaining files.

    :return: how many files were packed, and how many runs the archive holds
    :raise ValueError: if a file or the archive is damaged; nothing is changed then
    """
    with _locked(folder):
        files = {path: path.read_text(encoding="utf-8") for path in sorted(run_path("*", folder).parent.glob("*.json"))}
        for path, line in files.items():
            if name_of(_parsed(line, path)["run"]) != path.stem:
                raise ValueError(f"{path} holds the result of another run than its name says: delete it.")
        before = read_archive(folder)
        after = {**before, **{path.stem: line for path, line in files.items()}}
        if after != before:
            _write_archive(folder, after)
        for path, line in files.items():
            if path.read_text(encoding="utf-8") == line:  # else the run was made again in the meantime
                path.unlink()
    return len(files), len(after)


def read_archive(folder: Path) -> Mapping[str, str]:
    """The packed results of a folder: lines of JSON by the name of their run.

    An archive is read once per process, and again only after it has been replaced.

    :raise ValueError: if the archive is damaged
    """
    path = folder / ARCHIVE
    try:
        status = path.stat()
    except FileNotFoundError:
        return {}
    return _read(path, status.st_ino, status.st_mtime_ns, status.st_size)


@cache
def _read(path: Path, *version: int) -> Mapping[str, str]:
    try:
        with lzma.open(path, "rt", encoding="utf-8", newline="\n") as file:
            lines = list(file)
    except (lzma.LZMAError, EOFError, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error
    return {name_of(_parsed(line, path)["run"]): line for line in lines}


def _write_archive(folder: Path, lines: Mapping[str, str]) -> None:
    with atomic_path(folder / ARCHIVE) as temporary, open(temporary, "wb") as file:
        file.write(lzma.compress("".join(lines[name] for name in sorted(lines)).encode()))
        file.flush()
        os.fsync(file.fileno())  # because the files are deleted next


def _parsed(line: str, path: Path) -> dict[str, Any]:
    """The result that a line holds."""
    try:
        if line.find("\n") != len(line) - 1:
            raise ValueError("a result is one line")
        result: dict[str, Any] = json.loads(line)
        name_of(result["run"])
    except (ValueError, TypeError, KeyError) as error:
        raise _damaged(path, error) from error
    return result


def _damaged(path: Path, error: Exception) -> ValueError:
    what = "an archive of results" if path.name == ARCHIVE else "the result of a run"
    mend = "restore it, or delete it to make its runs again" if path.name == ARCHIVE else "delete it to make it again"
    return ValueError(f"{path} is not {what} ({type(error).__name__}: {error}): {mend}.")


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two descriptions are of the same run; a parameter that only one constructor has was not used."""
    shared = one.get("defaults", {}).keys() & other["defaults"].keys()
    changed = any(one["defaults"][name] != other["defaults"][name] for name in shared)
    return not changed and one | {"defaults": None} == other | {"defaults": None}


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lets one process pack a folder at a time; the lock ends with the process, however that ends."""
    if sys.platform == "win32":  # where a folder cannot be locked
        yield
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
