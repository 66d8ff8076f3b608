"""Options that several commands have."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sb3_sap.evaluation.laps import ENVIRONMENTS


def add_simulator(command: argparse.ArgumentParser) -> None:
    """Adds ``--simulator`` to a command."""
    command.add_argument("--simulator", choices=list(ENVIRONMENTS), default="highway", help="what the car drives on")


def add_path(command: argparse.ArgumentParser, flag: str, **settings: Any) -> None:
    """Adds an option that is a path or None, whose help says itself what is taken without it."""
    command.set_defaults(**{flag.removeprefix("--"): None})
    command.add_argument(flag, type=Path, default=argparse.SUPPRESS, **settings)


def add_vecnormalize(command: argparse.ArgumentParser) -> None:
    """Adds ``--vecnormalize`` to a command that loads a policy."""
    text = "statistics of SB3's VecNormalize (default: those beside the model, if there are any)"
    add_path(command, "--vecnormalize", metavar="FILE", help=text)
