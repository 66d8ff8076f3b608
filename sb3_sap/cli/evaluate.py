"""``sb3-sap evaluate``: laps with a saved model."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.cli.laps import drive_tracks, results_table
from sb3_sap.cli.options import add_path, add_simulator, add_vecnormalize
from sb3_sap.evaluation.laps import write_results
from sb3_sap.evaluation.normalisation import NormalisedPolicy
from sb3_sap.evaluation.policies import load_policy


def add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds ``sb3-sap evaluate``."""
    command = commands.add_parser(
        "evaluate",
        help="drive laps with a saved model",
        description="Drives one lap of each track with the saved policy alone, prints a table and writes it as JSON. "
        "Loading a model file or statistics runs code that they contain: load only files that you trust.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("model", type=Path, help="the .zip file of any SB3 model of the lane-keeping task")
    command.add_argument("--tracks", nargs="+", default=list(TEST_TRACKS), metavar="TRACK", help="tracks to drive")
    add_path(command, "--json", help="file of the results (default: evaluation.json beside the model)")
    add_vecnormalize(command)
    add_simulator(command)
    command.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace, console: Console) -> int:
    policy = load_policy(options.model, options.vecnormalize)
    if isinstance(policy, NormalisedPolicy):
        console.print(f"Observations are normalised with {policy.path}.", soft_wrap=True)
    results = drive_tracks(policy, options.tracks, options.simulator, console)
    console.print(results_table(results))
    write_results(options.json or options.model.parent / "evaluation.json", results)
    return 0
