"""Finding an installed TORCS, and reporting what is missing before its libraries, which would crash, are loaded."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

from sb3_sap.common.errors import nearest

#: Folders below the root, and in them the libraries of the simulator and of the track builder.
LIBRARIES = Path("usr/lib/x86_64-linux-gnu")
DATA = Path("usr/share/games/torcs")
MODULES = {"simu": LIBRARIES / "torcs/modules/simu/simuv2.so", "track": LIBRARIES / "torcs/modules/track/track.so"}
#: Libraries that all simulations share, in the order in which they must be loaded.
SHARED = (
    LIBRARIES / "torcs/lib/libtxml.so",
    LIBRARIES / "torcs/lib/libtgf.so",
    LIBRARIES / "torcs/lib/librobottools.so",
    LIBRARIES / "libplibul.so.1",
    LIBRARIES / "libplibsg.so.1",
)
#: End of the errors about a missing installation.
HOW_TO_INSTALL = "run `sb3-sap torcs install`, or `apt-get install torcs` on Debian, or set TORCS_ROOT to where it is"
#: Debian's torcs for amd64, whose structures are known; ``checksums.txt`` has the SHA-256 of each file that is used.
VERSION = "1.3.7+dfsg-5+b2"


class TorcsNotFoundError(RuntimeError):
    """TORCS is missing, damaged, or of a version or machine that this package cannot drive."""


def user_root() -> Path:
    """Where ``sb3-sap torcs install`` puts TORCS."""
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    return Path(data) / "sb3_sap" / "torcs"


@cache
def checksums() -> dict[Path, str]:
    """SHA-256 of every file of TORCS that is used, by its path below the root."""
    lines = resources.files(__package__).joinpath("checksums.txt").read_text(encoding="ascii").splitlines()
    return {Path(path): digest for digest, path in map(str.split, lines)}


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@dataclass(frozen=True)
class Installation:
    """A complete installation of TORCS."""

    root: Path

    def tracks(self) -> dict[str, Path]:
        """Every track's file by its directory name, such as ``"wheel-2"``."""
        files = (self.root / DATA / "tracks").glob("*/*/*.xml")
        return {path.stem: path for path in sorted(files) if path.stem == path.parent.name}

    def cars(self) -> dict[str, Path]:
        """Every car's file by its directory name, such as ``"car1-trb1"``."""
        files = (self.root / DATA / "cars").glob("*/*.xml")
        return {path.stem: path for path in sorted(files) if path.stem == path.parent.name}

    def track(self, name: str) -> Path:
        """The file of a track."""
        return _one_of("track", name, self.tracks())

    def car(self, name: str) -> Path:
        """The file of a car."""
        return _one_of("car", name, self.cars())

    def category(self, name: str) -> Path:
        """The file of a category of cars, whose name is in a car's file."""
        path = self.root / DATA / "categories" / f"{name}.xml"
        if not path.is_file():
            raise TorcsNotFoundError(
                f"TORCS under {self.root} lacks {path.name}, the car's category: {HOW_TO_INSTALL}."
            )
        return path

    def surfaces(self) -> Path:
        """The file of the road surfaces, which the tracks share."""
        return self.root / DATA / "data/tracks/surfaces.xml"

    def is_original(self, path: Path) -> bool:
        """Whether a file is, to the byte, one that TORCS ships."""
        return path.is_relative_to(self.root) and digest(path) == checksums().get(path.relative_to(self.root))


def find_installation() -> Installation:
    """The TORCS of ``TORCS_ROOT`` if it is set, else of the user's data folder, else of the system.

    :raise TorcsNotFoundError: if there is none that can be used, saying why
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise TorcsNotFoundError(
            f"TORCS' physics runs in process on Linux on x86_64 alone, but this is {sys.platform} on "
            f"{platform.machine()}: use sap/LaneKeeping-v0, the embedded simulator."
        )
    named = os.environ.get("TORCS_ROOT")
    for root in [Path(named)] if named else [user_root(), Path("/")]:
        if (root / MODULES["simu"]).is_file():
            return check_installation(root)
    where = f"TORCS_ROOT={named}" if named else f"{user_root()} and the system"
    raise TorcsNotFoundError(f"There is no TORCS in {where}: {HOW_TO_INSTALL}.")


def check_installation(root: Path) -> Installation:
    """Checks that all files exist and that the libraries are those whose structures are known."""
    for path in (*SHARED, *MODULES.values(), DATA / "tracks", DATA / "cars", DATA / "categories"):
        if not (root / path).exists():
            raise TorcsNotFoundError(f"TORCS under {root} is not whole, {path} is missing: {HOW_TO_INSTALL}.")
    for path in (*SHARED, *MODULES.values()):
        if digest(root / path) != checksums()[path]:
            raise TorcsNotFoundError(
                f"{root / path} is not that of Debian's torcs {VERSION} for amd64, the only one that is known and "
                f"cannot crash Python: {HOW_TO_INSTALL}."
            )
    return Installation(root)


def _one_of(kind: str, name: str, known: dict[str, Path]) -> Path:
    if name not in known:
        raise ValueError(f"{kind} must be one that TORCS ships, got {name!r}: {nearest(name, known, n=3, cutoff=0.4)}")
    return known[name]
