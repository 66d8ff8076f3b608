"""Provenance of a result: versions, kind of machine, date and revision, and nothing private."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "sb3-sap",
    "stable-baselines3",
    "sb3-contrib",
    "sbx-rl",
    "torch",
    "jax",
    "gymnasium",
    "highway-env",
    "numpy",
)


def provenance() -> dict[str, Any]:
    """The provenance of a result that this process makes."""
    return {
        "versions": {"python": platform.python_version()} | _versions(),
        "machine": machine_kind(),
        "date": datetime.now(UTC).date().isoformat(),
        "revision": revision(),
    }


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def machine_kind() -> str:
    """Processor model, number of cores and operating system."""
    processor = platform.processor() or platform.machine()
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    if match := re.search(r"^model name\s*: (.+)$", text, re.MULTILINE):
        processor = match[1].strip()
    return f"{processor}, {os.cpu_count()} cores, {platform.system()}"


def revision() -> str | None:
    """The commit of a checkout, marked as dirty if files differ from it; None for an installed package."""
    folder = Path(__file__).parents[2]
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=10", "--exclude=*", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
