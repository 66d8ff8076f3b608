"""Tracks: the five of Fig. 3 with their real plan, generated ones, and TORCS' own files."""

from __future__ import annotations

import os
from functools import lru_cache
from importlib import resources
from pathlib import Path

from sb3_sap.common.errors import nearest
from sb3_sap.envs.tracks.files import parse_table, read_track_xml, write_table
from sb3_sap.envs.tracks.generate import generate_track
from sb3_sap.envs.tracks.geometry import Piece, Segment, Track

#: The tracks of Fig. 3: TORCS' directory name of each, and the paper's name. The paper trains on the first and tests
#: on the rest.
TRACKS = {
    "wheel-2": "Wheel-2",
    "eroad": "E-road",
    "spring": "Spring",
    "g-track-3": "CG Track 3",
    "ole-road-1": "Oleth Ross Road",
}


def get_track(track: str | os.PathLike[str] | Track) -> Track:
    """Return a track by its name, its seed or its file.

    :param track: a key of `TRACKS`; ``"random:SEED"`` for a generated track (``"random"`` is ``"random:0"``); the path
        of a TORCS track file (``.xml``) or of a table such as `write_table` writes; or a `Track`, returned as it is
    :raise ValueError: if there is no such track, with the nearest names
    """
    if isinstance(track, Track):
        return track
    name = os.fspath(track)
    if name in TRACKS:
        return _shipped(name)
    kind, _, seed = name.partition(":")
    if kind == "random" and (seed.isdecimal() or name == kind):
        return generate_track(int(seed or 0))
    path = Path(name)
    if path.is_file():
        return read_track_xml(path) if path.suffix == ".xml" else _read_table(path)
    names = [*TRACKS, "random", "random:SEED"]
    hint = nearest(name.lower(), names, n=3, cutoff=0.4)
    raise ValueError(f"track must be a known name or the path of a track file, got {name!r}: {hint}")


@lru_cache
def _shipped(name: str) -> Track:
    table = resources.files(__package__).joinpath("data", f"{name}.csv").read_text(encoding="utf-8")
    return parse_table(table.splitlines(), name)


def _read_table(path: Path) -> Track:
    try:
        return parse_table(path.read_text(encoding="utf-8").splitlines(), path.stem)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a track table: it is not text ({error.reason}).") from error


__all__ = [
    "TRACKS",
    "Piece",
    "Segment",
    "Track",
    "generate_track",
    "get_track",
    "parse_table",
    "read_track_xml",
    "write_table",
]
