"""The commands of ``sb3-sap benchmark``: which grid they make, and which report they write."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.evaluation.racing import RACING

if TYPE_CHECKING:
    from sb3_sap.benchmark.configurations import Configuration
    from sb3_sap.benchmark.reports.results import Results
    from sb3_sap.benchmark.runs import Run

#: Each report, the configurations that it shows by default, and what it is.
REPORTS = {
    "table2": (["paper"], "Table 2 of the paper beside our figures"),
    "figure4": (["paper"], "Figures 4a and 4b: reward during training"),
    "figure5": (["ddpg_ap:paper", "ddpg_ap_ce2:paper", "ddpg_ap:default"], "Figure 5: accuracy of the AP predictor"),
    "table2_adam": (["paper_adam"], "Table 2, with the AP predictor fitted by Adam"),
    "figure4_adam": (["paper_adam"], "Figures 4a and 4b, with the AP predictor fitted by Adam"),
    "figure5_adam": (["ddpg_ap:paper_adam", "ddpg_ap_ce2:paper_adam"], "Figure 5, with the predictor fitted by Adam"),
    "curve": (["all"], "S and laps on the test tracks over training steps"),
    "summary": (["all"], "statistics of all configurations, and how probably one improves on another"),
    "headline": (["headline"], "the table of the README: S and laps after 250, 500, 1,000 and 3,000 steps"),
    "ablations": (["ablations"], "summary of DDPG-AP with one thing changed at a time"),
    "details": (["details"], "summary of details that the paper leaves open, one changed at a time"),
    "readings": (["readings"], "summary of readings of how the paper fits its AP predictor"),
    "auxiliary": (["auxiliary"], "summary of how often the auxiliary actor loss is applied"),
    "robustness": (["robustness"], "summary at 80 km/h and from random starts, for which nothing was tuned"),
    "ways": (["ways"], "ways of using the label: none, as a reward penalty, a loss beside it, and guidance"),
    "failing": (["failing"], "the same for the penalty alone, on many seeds: how many runs fail"),
    "equal_budget": (["equal_budget"], "the same, with settings that every way has tuned with the same budget"),
    "on_policy": (["on_policy"], "the same for PPO"),
    "starts": (["starts"], "the same for runs that begin with knowledge of elsewhere"),
    "wrong_labels": (["wrong_labels"], "the same for labels that are wrong"),
}
#: Reports that are summaries of other configurations.
SUMMARIES = ("summary", "ablations", "details", "readings", "auxiliary", "robustness")
#: Reports that compare ways of using the label.
WAYS = ("ways", "failing", "equal_budget", "on_policy", "wrong_labels", "starts", "parts")
#: Tracks that these and racing drive at the last checkpoint only: a lap of Spring takes longer than of all others
#: together.
LONG_LAPS = ("spring",)
#: Tracks of racing: that of the training, and those of the test.
RACE_TRACKS = ("wheel-2", *TEST_TRACKS)
#: Training steps of the paper's two experiments.
PAPER_STEPS = (3_000, 15_000)
#: Readings of how the paper fits its predictor, as groups of configurations, and the file of their claims.
READINGS = {"paper": "claims", "paper_adam": "claims-adam"}


def run(options: argparse.Namespace, console: Console) -> int:
    """Makes the missing runs."""
    return int(_run_missing(options, options.steps, console) > 0)


def report(options: argparse.Namespace, console: Console) -> int:
    """Makes the missing runs of a report and writes it."""
    failed = _run_missing(options, options.steps, console)
    _write(options, options.report, console)
    return int(failed > 0)


def task(options: argparse.Namespace, console: Console) -> int:
    """Makes the missing runs of a task beyond lane keeping and writes its page."""
    from sb3_sap.benchmark.task_reports import COMPARED
    from sb3_sap.benchmark.task_settings import EPISODES, planned_steps

    races = options.simulator == RACING
    if options.tracks and not races:
        raise ValueError(f"--tracks is for {RACING}: the other tasks have no tracks, leave it out.")
    options.tracks = options.tracks or list(RACE_TRACKS if races else EPISODES)
    options.report = options.report or ("races" if races else "returns")
    if races != (options.report == "races"):
        raise ValueError(f"The report 'races' is for {RACING}, and no other report is: leave --report out.")
    options.steps = options.steps or planned_steps(options.simulator)
    compared = COMPARED[options.report]
    options.configurations = options.configurations or compared(options.simulator)
    failed = _run_missing(options, options.steps, console)
    _write(options, options.report, console)
    return int(failed > 0)


def claims(options: argparse.Namespace, console: Console) -> int:
    """Makes the missing runs of the paper's experiments and judges its claims."""
    options.configurations = [options.reading]
    failed = sum(_run_missing(options, steps, console) for steps in PAPER_STEPS)
    _write_claims(options, console)
    return int(failed > 0)


def report_all(options: argparse.Namespace, console: Console) -> int:
    """Writes every report of lane keeping from the results that exist."""
    from sb3_sap.benchmark.reports.results import NoResults

    written = 0
    for name, (configurations, _) in REPORTS.items():
        if name.endswith("_adam"):  # whose seeds are others
            continue
        options.configurations, options.report = configurations, name
        try:
            _write(options, name, console, leave_out_unknown=True)
            written += 1
        except NoResults as error:
            console.print(f"{name} is left out: {error}", soft_wrap=True, markup=False)
    if written:
        options.report, options.reading = "claims", "paper"
        _write_claims(options, console)
    return int(written == 0)


def pack(options: argparse.Namespace, console: Console) -> int:
    """Packs the results of every grid."""
    from sb3_sap.benchmark import store

    folders = sorted({path.parent.parent for path in options.out.glob("*/runs/*.json")})
    for folder in folders:
        packed, total = store.pack(folder)
        console.print(f"{folder / store.ARCHIVE} holds {total} runs, {packed} of which were packed now", soft_wrap=True)
    if not folders:
        console.print(f"there are no runs to pack in {options.out}/", soft_wrap=True)
    return 0


def _run_missing(options: argparse.Namespace, steps: int, console: Console) -> int:
    from sb3_sap.benchmark.dispatch import run_grid

    grid, folder = _grid(options, steps), _folder(options, steps)
    return run_grid(grid, folder, console, options.jobs, options.backend, options.scheduler)


def _write(options: argparse.Namespace, name: str, console: Console, leave_out_unknown: bool = False) -> None:
    from sb3_sap.benchmark.reports import figures, races, returns, summary, tables, ways
    from sb3_sap.benchmark.reports.results import collect

    folder = _folder(options, options.steps)
    grid = _grid(options, options.steps, console if leave_out_unknown else None)
    results = collect(grid, folder, options.simulator, options.steps)
    writers: dict[str, Callable[[Results, Path, str], None]] = {
        **{kind: partial(tables.table_2, name=kind) for kind in ("table2", "table2_adam")},
        **{kind: partial(figures.figure_4, name=kind) for kind in ("figure4", "figure4_adam")},
        **{kind: partial(figures.figure_5, name=kind) for kind in ("figure5", "figure5_adam")},
        "curve": figures.curve,
        "headline": tables.headline,
        **{kind: partial(summary.summary, name=kind) for kind in SUMMARIES},
        "returns": returns.returns,
        "races": races.races,
        **{kind: partial(ways.ways, kind=kind) for kind in WAYS},
    }
    writers[name](results, folder, command_line(options, name))
    console.print(f"wrote {folder / name}.md", soft_wrap=True)


def _write_claims(options: argparse.Namespace, console: Console) -> None:
    from sb3_sap.benchmark.reports.claims import claims
    from sb3_sap.benchmark.reports.results import NoResults, collect

    options.configurations = [options.reading]
    found = {}
    for steps in PAPER_STEPS:
        try:
            found[steps] = collect(_grid(options, steps), _folder(options, steps), options.simulator, steps)
        except NoResults:
            continue
    path = options.out / f"{options.simulator}-{READINGS[options.reading]}.md"
    if found:
        claims(found, path, command_line(options, "claims"), options.reading)
        console.print(f"wrote {path}", soft_wrap=True)


def _grid(options: argparse.Namespace, steps: int, console: Console | None = None) -> dict[Configuration, list[Run]]:
    """The grid of a command.

    :param console: where configurations are reported that cannot be built here, such as those of SBX where it is not
        installed; None raises their error
    """
    from sb3_sap.benchmark.configurations import parse_configurations
    from sb3_sap.benchmark.runs import make_grid

    seeds = range(options.first_seed, options.first_seed + options.seeds)
    later = LONG_LAPS if getattr(options, "report", None) in (*WAYS, "races") else ()
    grid: dict[Configuration, list[Run]] = {}
    left_out: dict[str, ValueError] = {}
    for configuration in parse_configurations(options.configurations):
        try:
            grid |= make_grid([configuration], options.simulator, steps, seeds, options.tracks, later)
        except ValueError as error:
            if console is None:
                raise
            left_out[configuration.name] = error
    if console is not None and left_out:
        reason = next(iter(left_out.values()))
        console.print(f"{', '.join(left_out)} cannot be reported: {reason}", soft_wrap=True, markup=False)
    return grid


def _folder(options: argparse.Namespace, steps: int) -> Path:
    # Runs of a task may differ in length, and the namespace of its id would be another folder.
    beyond = options.simulator not in ENVIRONMENTS
    name = options.simulator.rpartition("/")[2] if beyond else f"{options.simulator}-{steps}"
    folder: Path = options.out / "-".join([name, *(Path(track).stem for track in _tracks_of_races(options))])
    return folder


def _tracks_of_races(options: argparse.Namespace) -> list[str]:
    """The tracks of racing, unless they are those of its page."""
    return options.tracks if options.simulator == RACING and options.tracks != list(RACE_TRACKS) else []


def command_line(options: argparse.Namespace, name: str) -> str:
    """The command that makes a report, without the flags that do not change it."""
    beyond = options.simulator not in ENVIRONMENTS
    words = ["sb3-sap", "benchmark", *(["task"] if beyond else [name, "--simulator"]), options.simulator]
    words += ["--report", name] if beyond and name not in ("returns", "races") else []
    words += [] if name == "claims" else ["--steps", str(options.steps)]
    words += ["--seeds", str(options.seeds)]
    words += ["--first-seed", str(options.first_seed)] if options.first_seed else []
    if name == "claims":
        words += ["--reading", options.reading] if options.reading != "paper" else []
    elif options.configurations != (REPORTS[name][0] if name in REPORTS and not beyond else ["paper"]):
        words += ["--configurations", *options.configurations]
    tracks = _tracks_of_races(options) if beyond else [] if options.tracks == list(TEST_TRACKS) else options.tracks
    words += ["--tracks", *tracks] if tracks else []
    return shlex.join(words)
