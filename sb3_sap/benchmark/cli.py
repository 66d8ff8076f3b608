"""The command line of ``sb3-sap benchmark``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from sb3_sap.benchmark import commands as actions
from sb3_sap.benchmark.groups import GROUPS
from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.common.command_line import positive
from sb3_sap.evaluation.laps import ENVIRONMENTS

Command = Callable[[argparse.Namespace, Console], int]
OUT = Path("results")


def add_benchmark(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the commands of the benchmark to the main parser."""
    benchmark = commands.add_parser("benchmark", help="make the paper's experiments and more, and report them")
    added = benchmark.add_subparsers(title="commands", required=True, metavar="COMMAND")
    command = added.add_parser("run", help="train and evaluate configurations; results that exist are kept")
    _add_configurations(command, ["paper"])
    _add_grid(command)
    _add_workers(command)
    command.set_defaults(run=_with_extra(actions.run))
    for name, (configurations, text) in actions.REPORTS.items():
        command = added.add_parser(name, help=f"{text}; makes the missing runs", description=f"{text}.")
        _add_configurations(command, configurations)
        _add_grid(command)
        _add_workers(command)
        command.set_defaults(run=_with_extra(actions.report), report=name)
    command = added.add_parser("claims", help="each result that section 5.2 of the paper states, with a verdict")
    _add_grid(command, steps=False)
    _add_workers(command)
    command.add_argument(
        "--reading", choices=list(actions.READINGS), default="paper", help="how the paper fits its AP predictor"
    )
    command.set_defaults(run=_with_extra(actions.claims), tracks=list(TEST_TRACKS))
    command = added.add_parser("task", help="a task beyond lane keeping: guided, its base, RL Zoo's tuned settings")
    command.add_argument("simulator", metavar="ENV_ID", help="environment with a guided algorithm in zoo_configs")
    _add_configurations(command, [])
    _add_grid(command, lane_keeping=False)
    _add_workers(command)
    command.add_argument(
        "--report",
        choices=["returns", "ways", "starts", "parts", "races"],
        help="the page that is written; None: races of sap/TorcsRacing-v0, else returns",
    )
    command.add_argument(
        "--tracks", nargs="+", metavar="TRACK", help="of sap/TorcsRacing-v0; None: that of its entry and four others"
    )
    command.set_defaults(run=_with_extra(actions.task))
    command = added.add_parser("report", help="write all reports of lane keeping from the results that exist")
    _add_grid(command)
    command.set_defaults(run=_with_extra(actions.report_all))
    command = added.add_parser("pack", help="pack the results of single runs into one archive for each grid")
    _add_out(command)
    command.set_defaults(run=_with_extra(actions.pack))


def _add_configurations(command: argparse.ArgumentParser, configurations: list[str]) -> None:
    command.add_argument(
        "--configurations",
        nargs="+",
        default=configurations,
        metavar="CONFIGURATION",
        help="algo:preset, algo:preset[key=value,…], linear, or a group: "
        f"{', '.join(GROUPS)}; of a task the presets are task, tuned and default, and there is oracle",
    )


def _add_grid(command: argparse.ArgumentParser, steps: bool = True, lane_keeping: bool = True) -> None:
    if lane_keeping:
        command.add_argument("--simulator", choices=list(ENVIRONMENTS), default="torcs", help="simulator of the car")
    else:
        command.add_argument("--steps", type=positive, help="training steps; None: those of the guided algorithm")
    if steps and lane_keeping:
        command.add_argument("--steps", type=positive, default=3_000, help="training steps")
        command.add_argument("--tracks", nargs="+", default=list(TEST_TRACKS), metavar="TRACK", help="test tracks")
    command.add_argument("--seeds", type=positive, default=10, metavar="N", help="number of runs per configuration")
    command.add_argument("--first-seed", type=int, default=0, metavar="SEED", help="use 100 and up to choose settings")
    _add_out(command)


def _add_out(command: argparse.ArgumentParser) -> None:
    command.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    command.add_argument("--out", type=Path, default=OUT, help="folder that holds a folder of results for each grid")


def _add_workers(command: argparse.ArgumentParser) -> None:
    command.add_argument("--jobs", type=positive, default=1, metavar="N", help="runs side by side on this machine")
    command.add_argument("--backend", choices=["local", "dask"], default="local", help="dask: on a cluster")
    command.add_argument("--scheduler", metavar="ADDRESS", help="address of the Dask scheduler")


def _with_extra(run: Command) -> Command:
    """The same command, which names the extra if one of its libraries is missing."""

    def checked(options: argparse.Namespace, console: Console) -> int:
        try:
            return run(options, console)
        except ModuleNotFoundError as error:
            raise ValueError(f"sb3-sap benchmark needs {error.name}: pip install 'sb3-sap[benchmark]'.") from error

    return checked
