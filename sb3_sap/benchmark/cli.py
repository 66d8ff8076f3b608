"""``sb3-sap benchmark …``: the paper's experiments, run and reported."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.evaluation import ENVIRONMENTS

BACKENDS = ("local", "dask")


def add_benchmark(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the commands to the main parser."""
    benchmark = commands.add_parser("benchmark", help="run the paper's experiments, and more, and report them")
    actions = benchmark.add_subparsers(title="commands", required=True, metavar="COMMAND")
    command = actions.add_parser("run", help="run the training runs of some columns, as far as they are missing")
    _add_grid(command, ["paper"])
    command.set_defaults(run=_run)


def _add_grid(command: argparse.ArgumentParser, columns: list[str]) -> None:
    command.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    command.add_argument(
        "--columns",
        nargs="+",
        default=columns,
        metavar="COLUMN",
        help="algo:preset, algo:preset[key=value,…], linear, or a group: paper, peers, guided, sbx, ablations, all",
    )
    command.add_argument("--simulator", choices=list(ENVIRONMENTS), default="torcs", help="what the car drives on")
    command.add_argument("--steps", type=_positive, default=3_000, help="training steps")
    command.add_argument("--seeds", type=_positive, default=10, metavar="N", help="training runs of each column")
    command.add_argument("--first-seed", type=int, default=0, metavar="SEED", help="100 and up to choose settings")
    command.add_argument("--tracks", nargs="+", default=list(TEST_TRACKS), metavar="TRACK", help="unseen tracks")
    command.add_argument("--jobs", type=_positive, default=1, metavar="N", help="runs side by side on this machine")
    command.add_argument("--backend", choices=BACKENDS, default="local", help="dask: on a cluster")
    command.add_argument("--scheduler", metavar="ADDRESS", help="of the Dask cluster")
    command.add_argument("--out", type=Path, default=Path("docs/results"), help="holds a folder SIMULATOR-STEPS")


def _run(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.benchmark.cells import make_grid
    from sb3_sap.benchmark.columns import parse_columns
    from sb3_sap.benchmark.runner import run_grid

    seeds = range(options.first_seed, options.first_seed + options.seeds)
    grid = make_grid(parse_columns(options.columns), options.simulator, options.steps, seeds, options.tracks)
    folder = options.out / f"{options.simulator}-{options.steps}" / "cells"
    return int(run_grid(grid, folder, console, options.jobs, options.backend, options.scheduler) > 0)


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, but is {number}")
    return number
