"""The ``sb3-sap`` command."""

from __future__ import annotations

import argparse
import os
import sys

import torch as th
from rich.console import Console

import sb3_sap
from sb3_sap import zoo
from sb3_sap.benchmark.cli import add_benchmark
from sb3_sap.cli.compare import add_compare
from sb3_sap.cli.demo import add_demo
from sb3_sap.cli.evaluate import add_evaluate
from sb3_sap.cli.hub import add_push_to_hub
from sb3_sap.cli.predictor import add_predictor
from sb3_sap.cli.torcs import add_torcs
from sb3_sap.common.command_line import run_command


def main(arguments: list[str] | None = None) -> int:
    """Runs a command and returns its exit code; an expected error is printed as one sentence."""
    arguments = sys.argv[1:] if arguments is None else arguments
    # Networks this small run no faster on two threads, and one thread always adds in the same order.
    th.set_num_threads(1)
    _find_modules_of_current_folder()
    if arguments and arguments[0] in zoo.COMMANDS:
        return zoo.main(arguments)  # RL Zoo reads its flags itself
    options = parser().parse_args(arguments)
    return run_command(lambda: int(options.run(options, Console())))


def _find_modules_of_current_folder() -> None:
    """Makes a user's own modules importable, as ``python -m`` does, but after what is installed."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.append(os.getcwd())


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    root = argparse.ArgumentParser(prog="sb3-sap", description=sb3_sap.__doc__)
    root.add_argument("--version", action="version", version=f"%(prog)s {sb3_sap.__version__}")
    commands = root.add_subparsers(title="commands", required=True, metavar="COMMAND")
    add_demo(commands)
    add_compare(commands)
    add_evaluate(commands)
    add_predictor(commands)
    add_benchmark(commands)
    add_torcs(commands)
    add_push_to_hub(commands)
    for name, summary in zoo.COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)
    return root


if __name__ == "__main__":
    sys.exit(main())
