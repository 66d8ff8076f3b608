"""Getting Debian's TORCS without root: download the packages, keep the few files that the physics needs."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from sb3_sap.envs.torcs.installation import (
    VERSION,
    Installation,
    TorcsNotFoundError,
    check_installation,
    checksums,
    digest,
)

#: Debian's packages.
PACKAGES = ("torcs", "torcs-data", "libplib1")


def install(root: Path) -> Installation:
    """Downloads the packages with apt, unpacks what is needed and puts it into ``root``, all or nothing.

    :raise TorcsNotFoundError: if a tool or a package is missing, or the version is not the one that is known
    """
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise TorcsNotFoundError(f"{tool} is not there: this command needs Debian or one of its descendants.")
    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root.parent, prefix=".torcs-") as folder:
        work = Path(folder)
        _download(work)
        unpacked = work / "unpacked"
        for package in work.glob("*.deb"):
            _run(["dpkg-deb", "-x", str(package), str(unpacked)], work, "download it again")
            package.unlink()
        kept = work / "kept"
        for path, expected in checksums().items():
            _keep(unpacked / path, kept / path, expected)
        old = work / "old"
        if root.exists():
            os.replace(root, old)
        os.replace(kept, root)
    return check_installation(root)


def _download(folder: Path) -> None:
    command = ["apt-get", "download", *PACKAGES]
    if os.geteuid() == 0:
        if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0:
            return
        # A new machine has no package lists yet.
        _run(["apt-get", "update"], folder, "check the network")
    _run(command, folder, "run `apt-get update` first, as root, or check the network")


def _keep(source: Path, target: Path, expected: str) -> None:
    if not source.is_file() or digest(source) != expected:
        raise TorcsNotFoundError(
            f"The packages' {source.name} is not that of Debian's torcs {VERSION} for amd64, the only version that is "
            "known: nothing was installed."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)


def _run(command: list[str], folder: Path, remedy: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        raise TorcsNotFoundError(f"`{' '.join(command[:2])}` failed ({lines[-1]}): {remedy}.")
