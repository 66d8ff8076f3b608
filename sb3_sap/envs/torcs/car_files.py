"""The files of a track and a car, checked before TORCS' own code, which would only crash, reads them."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

from sb3_sap.envs.torcs.installation import Installation
from sb3_sap.envs.torcs.libraries import MERGE_ALL, READ_STANDARD, Shared, reading


class Files(NamedTuple):
    """The files of one car on one track."""

    track: Path
    car: Path
    category: Path

    def unknown(self, installation: Installation) -> list[Path]:
        """Those that are not, to the byte, what TORCS ships."""
        return [file for file in self if not installation.is_original(file)]


def find_files(track: str | os.PathLike[str], car: str, installation: Installation) -> Files:
    """Finds the files.

    :param track: name of a track that TORCS ships, or the path of a track file
    :param car: name of a car that TORCS ships
    :raise ValueError: for a track or a car that does not exist, or road surfaces that TORCS does not ship
    """
    path = Path(track)
    track_file = path if path.suffix == ".xml" and path.is_file() else installation.track(str(track))
    car_file = installation.car(car)
    surfaces = installation.surfaces()
    if surfaces.is_file() and not installation.is_original(surfaces):
        # TORCS would load it, with another grip on every track.
        raise ValueError(f"{surfaces}, the road surfaces, is not the one that TORCS ships: install TORCS' data again.")
    return Files(track_file, car_file, installation.category(car_category(car_file)))


def read_car(shared: Shared, files: Files) -> Any:
    """TORCS' handle of a car's parameters, merged with those of its category."""
    with reading():
        handles = [shared.read_parameters(str(file).encode(), READ_STANDARD) for file in (files.category, files.car)]
        if not all(handles):
            raise ValueError(f"TORCS cannot read {files.car} with {files.category}: install TORCS' data again.")
        return shared.merge(*handles, MERGE_ALL)


def car_category(path: Path) -> str:
    """The category that a car's file names."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a readable TORCS car file ({error}): install TORCS' data again.") from error
    found = root.find("section[@name='Car']/attstr[@name='category']")
    if found is None:
        raise ValueError(f"{path} names no category in its section 'Car': install TORCS' data again.")
    return found.get("val", "")
