"""``sb3-sap benchmark …``: the paper's experiments, run and reported."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.common.command_line import positive
from sb3_sap.evaluation.laps import ENVIRONMENTS

if TYPE_CHECKING:
    from sb3_sap.benchmark.cells import Cell
    from sb3_sap.benchmark.columns import Column
    from sb3_sap.benchmark.results import Results

Command = Callable[[argparse.Namespace, Console], int]
#: Each report, the columns that it shows unless told otherwise, and what it is.
REPORTS = {
    "table2": (["paper"], "Table 2, the paper's figures beside ours"),
    "figure4": (["paper"], "Figures 4a and 4b: reward while training"),
    "figure5": (["ddpg_ap:paper", "ddpg_ap_ce2:paper", "ddpg_ap:default"], "Figure 5: accuracy of the AP predictor"),
    "curve": (["all"], "S and laps on the unseen tracks against training steps"),
    "summary": (["all"], "statistics of all columns, and how probably one beats another"),
    "headline": (["headline"], "the README's table: S and laps after 250, 500, 1,000 and 3,000 steps"),
    "ablations": (["ablations"], "the same of DDPG-AP with one thing changed at a time"),
    "readings": (["readings"], "the same where the paper can be read otherwise"),
    "lessons": (["lessons"], "the actor taught after every update of it, or as often as E is fitted"),
    "harder": (["harder"], "the same at 80 km/h, and from random starts, with nothing tuned for it"),
}
#: Those that are nothing but the statistics of their columns.
SUMMARIES = ("summary", "ablations", "readings", "lessons", "harder")
#: Trainings of the paper, by their steps.
PAPER_STEPS = (3_000, 15_000)


def add_benchmark(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the commands to the main parser."""
    benchmark = commands.add_parser("benchmark", help="run the paper's experiments, and more, and report them")
    actions = benchmark.add_subparsers(title="commands", required=True, metavar="COMMAND")
    command = actions.add_parser("run", help="train and evaluate columns, as far as that has not been done")
    _add_columns(command, ["paper"])
    _add_grid(command)
    _add_workers(command)
    command.set_defaults(run=_with_extra(_run))
    for name, (columns, text) in REPORTS.items():
        command = actions.add_parser(name, help=f"{text}; runs what is missing", description=f"{text}.")
        _add_columns(command, columns)
        _add_grid(command)
        _add_workers(command)
        command.set_defaults(run=_with_extra(_report), report=name)
    command = actions.add_parser("claims", help="each result that section 5.2 states, ours, and a verdict; 3k and 15k")
    _add_grid(command, steps=False)
    _add_workers(command)
    command.set_defaults(run=_with_extra(_claims), columns=["paper"], tracks=list(TEST_TRACKS))
    command = actions.add_parser("task", help="a task beyond lane keeping: guided, its base, RL Zoo's tuned settings")
    command.add_argument("simulator", metavar="ENV_ID", help="environment with a guided entry in zoo_configs")
    _add_columns(command, [])
    _add_grid(command, lane_keeping=False)
    _add_workers(command)
    command.set_defaults(run=_with_extra(_task))
    command = actions.add_parser("report", help="write all of these from the runs that there are; runs nothing")
    _add_grid(command)
    command.set_defaults(run=_with_extra(_report_all))


def _add_columns(command: argparse.ArgumentParser, columns: list[str]) -> None:
    command.add_argument(
        "--columns",
        nargs="+",
        default=columns,
        metavar="COLUMN",
        help="algo:preset, algo:preset[key=value,…], linear, or a group: paper, peers, guided, headline, sbx, "
        "ablations, readings, lessons, harder, all; of a task the presets are task, tuned and default",
    )


def _add_grid(command: argparse.ArgumentParser, steps: bool = True, lane_keeping: bool = True) -> None:
    command.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    if lane_keeping:
        command.add_argument("--simulator", choices=list(ENVIRONMENTS), default="torcs", help="what the car drives on")
    else:
        command.add_argument("--steps", type=positive, help="training steps; None: those of the guided entry")
    if steps and lane_keeping:
        command.add_argument("--steps", type=positive, default=3_000, help="training steps")
        command.add_argument("--tracks", nargs="+", default=list(TEST_TRACKS), metavar="TRACK", help="unseen tracks")
    command.add_argument("--seeds", type=positive, default=10, metavar="N", help="training runs of each column")
    command.add_argument("--first-seed", type=int, default=0, metavar="SEED", help="100 and up to choose settings")
    command.add_argument("--out", type=Path, default=Path("docs/results"), help="holds a folder of each grid")


def _add_workers(command: argparse.ArgumentParser) -> None:
    command.add_argument("--jobs", type=positive, default=1, metavar="N", help="runs side by side on this machine")
    command.add_argument("--backend", choices=["local", "dask"], default="local", help="dask: on a cluster")
    command.add_argument("--scheduler", metavar="ADDRESS", help="of the Dask cluster")


def _with_extra(run: Command) -> Command:
    """The same, which says so when a library of the extra is missing."""

    def checked(options: argparse.Namespace, console: Console) -> int:
        try:
            return run(options, console)
        except ModuleNotFoundError as error:
            raise ValueError(f"sb3-sap benchmark needs {error.name}: pip install 'sb3-sap[benchmark]'.") from error

    return checked


def _run(options: argparse.Namespace, console: Console) -> int:
    return int(_run_missing(options, options.steps, console) > 0)


def _report(options: argparse.Namespace, console: Console) -> int:
    failed = _run_missing(options, options.steps, console)
    _write(options, options.report, console)
    return int(failed > 0)


def _task(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.benchmark.tasks import EPISODES, planned_steps, task_columns

    options.tracks = list(EPISODES)
    options.steps = options.steps or planned_steps(options.simulator)
    options.columns = options.columns or task_columns(options.simulator)
    failed = _run_missing(options, options.steps, console)
    _write(options, "returns", console)
    return int(failed > 0)


def _claims(options: argparse.Namespace, console: Console) -> int:
    failed = sum(_run_missing(options, steps, console) for steps in PAPER_STEPS)
    _write_claims(options, console)
    return int(failed > 0)


def _report_all(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.benchmark.results import NoResults

    written = 0
    for name, (columns, _) in REPORTS.items():
        options.columns = columns
        try:
            _write(options, name, console, known_alone=True)
            written += 1
        except NoResults as error:
            console.print(f"{name} is left out: {error}", soft_wrap=True, markup=False)
    options.columns = ["paper"]
    if written:
        _write_claims(options, console)
    return int(written == 0)


def _run_missing(options: argparse.Namespace, steps: int, console: Console) -> int:
    from sb3_sap.benchmark.runner import run_grid

    folder = _folder(options, steps) / "cells"
    return run_grid(_grid(options, steps), folder, console, options.jobs, options.backend, options.scheduler)


def _write(options: argparse.Namespace, name: str, console: Console, known_alone: bool = False) -> None:
    from sb3_sap.benchmark import figures, returns, summary, tables
    from sb3_sap.benchmark.results import collect

    folder = _folder(options, options.steps)
    results = collect(_grid(options, options.steps, known_alone), folder / "cells", options.simulator, options.steps)
    writers: dict[str, Callable[[Results, Path, str], None]] = {
        "table2": tables.table_2,
        "figure4": figures.figure_4,
        "figure5": figures.figure_5,
        "curve": figures.curve,
        "headline": tables.headline,
        **{kind: partial(summary.summary, name=kind) for kind in SUMMARIES},
        "returns": returns.returns,
    }
    writers[name](results, folder, command_line(options, name))
    console.print(f"wrote {folder / name}.md", soft_wrap=True)


def _write_claims(options: argparse.Namespace, console: Console) -> None:
    from sb3_sap.benchmark.claims import claims
    from sb3_sap.benchmark.results import NoResults, collect

    found = {}
    for steps in PAPER_STEPS:
        try:
            folder = _folder(options, steps) / "cells"
            found[steps] = collect(_grid(options, steps), folder, options.simulator, steps)
        except NoResults:
            continue
    path = options.out / f"{options.simulator}-claims.md"
    if found:
        claims(found, path, command_line(options, "claims"))
        console.print(f"wrote {path}", soft_wrap=True)


def _grid(options: argparse.Namespace, steps: int, known_alone: bool = False) -> dict[Column, list[Cell]]:
    from sb3_sap.benchmark.cells import make_grid
    from sb3_sap.benchmark.columns import parse_columns

    seeds = range(options.first_seed, options.first_seed + options.seeds)
    grid: dict[Column, list[Cell]] = {}
    for column in parse_columns(options.columns):
        try:
            grid |= make_grid([column], options.simulator, steps, seeds, options.tracks)
        except ValueError:
            # Where SBX is not installed, the others can be reported all the same.
            if not known_alone:
                raise
    return grid


def _folder(options: argparse.Namespace, steps: int) -> Path:
    # A task's runs may differ in length; the id's namespace is no folder.
    task = options.simulator not in ENVIRONMENTS
    folder: Path = options.out / (options.simulator.rpartition("/")[2] if task else f"{options.simulator}-{steps}")
    return folder


def command_line(options: argparse.Namespace, name: str) -> str:
    """The command that makes a report, without what does not change it."""
    task = name == "returns"
    words = ["sb3-sap", "benchmark", *(["task"] if task else [name, "--simulator"]), options.simulator]
    words += [] if name == "claims" else ["--steps", str(options.steps)]
    words += ["--seeds", str(options.seeds)]
    words += ["--first-seed", str(options.first_seed)] if options.first_seed else []
    default = REPORTS[name][0] if name in REPORTS else ["paper"]
    words += ["--columns", *options.columns] if options.columns != default else []
    words += ["--tracks", *options.tracks] if not task and options.tracks != list(TEST_TRACKS) else []
    return shlex.join(words)
