"""Getting Debian's TORCS without root: download the packages, keep the few files that the physics needs."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from sb3_sap.envs.torcs.installation import (
    CHECKSUMS,
    DATA,
    LIBRARIES,
    Installation,
    TorcsNotFoundError,
    check_installation,
)

PACKAGES = ("torcs", "torcs-data", "libplib1")
KEPT = (
    (LIBRARIES / "torcs/lib", "*.so"),
    (LIBRARIES / "torcs/modules/simu", "*.so"),
    (LIBRARIES / "torcs/modules/track", "*.so"),
    (LIBRARIES, "libplib*.so*"),
    (DATA / "tracks", "*/*/*.xml"),
    (DATA / "data/tracks", "*.xml"),
    (DATA / "cars", "*/*.xml"),
    (DATA / "categories", "*.xml"),
)
"""(folder, pattern) of what is kept: about 7 MB of 550."""


def install(root: Path) -> Installation:
    """Downloads the packages with apt, unpacks what is needed and puts it into ``root``, all or nothing.

    :raise TorcsNotFoundError: if a tool or a package is missing, or what came is not the version that is known
    """
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise TorcsNotFoundError(f"{tool} is not there: this command needs Debian or one of its descendants.")
    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root.parent, prefix=".torcs-") as folder:
        work = Path(folder)
        _run(["apt-get", "download", *PACKAGES], work, "run `apt-get update` first, as root, or check the network")
        unpacked = work / "unpacked"
        for package in work.glob("*.deb"):
            _run(["dpkg-deb", "-x", str(package), str(unpacked)], work, "download it again")
            package.unlink()
        kept = work / "kept"
        for place, pattern in KEPT:
            for path in (unpacked / place).glob(pattern):
                target = kept / path.relative_to(unpacked)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, target)
        _verify(kept)
        old = work / "old"
        if root.exists():
            os.replace(root, old)
        os.replace(kept, root)
    return check_installation(root)


def _verify(kept: Path) -> None:
    for path, expected in CHECKSUMS.items():
        if not (kept / path).is_file():
            raise TorcsNotFoundError(f"The packages hold no {path}: only Debian's torcs for amd64 is known.")
        if hashlib.sha256((kept / path).read_bytes()).hexdigest() != expected:
            raise TorcsNotFoundError(
                f"The packages' {path.name} is not that of Debian's torcs 1.3.7+dfsg-5+b2, the version that is known: "
                "another would crash the process. Nothing was installed."
            )


def _run(command: list[str], folder: Path, remedy: str) -> None:
    # apt drops its rights for downloads, and the folder belongs to whoever runs this.
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise TorcsNotFoundError(f"`{' '.join(command[:2])}` failed ({lines[-1]}): {remedy}.")
