"""The ``sb3-sap`` command."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import torch as th
from rich.console import Console

from sb3_sap import __version__, zoo
from sb3_sap.benchmark.cli import add_benchmark
from sb3_sap.envs.torcs.cli import add_torcs
from sb3_sap.errors import not_negative, positive, run_command
from sb3_sap.evaluation import ENVIRONMENTS
from sb3_sap.hub import add_push_to_hub
from sb3_sap.normalisation import NormalisedPolicy, add_vecnormalize


def main(arguments: list[str] | None = None) -> int:
    """Runs a command and returns its exit code; what the user got wrong is told in one sentence."""
    arguments = sys.argv[1:] if arguments is None else arguments
    # Networks this small run no faster on two threads, and one thread always adds in the same order.
    th.set_num_threads(1)
    _find_modules_of_current_folder()
    if arguments and arguments[0] in zoo.COMMANDS:
        return zoo.main(arguments)  # RL Zoo reads its flags itself
    options = parser().parse_args(arguments)
    return run_command(lambda: int(options.run(options, Console())))


def _find_modules_of_current_folder() -> None:
    """Has environments and functions of a user's own found as by ``python -m``, but after what is installed."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.append(os.getcwd())


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    root = argparse.ArgumentParser(prog="sb3-sap", description="Learn which actions are permissible while acting.")
    root.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = root.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_evaluate(commands)
    add_benchmark(commands)
    add_torcs(commands)
    add_push_to_hub(commands)
    for name, summary in zoo.COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)
    return root


def _add_demo(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    from sb3_sap.algorithms import ALGORITHMS
    from sb3_sap.demo import Run

    default = Run()
    steering = [name for name in ALGORITHMS if "dqn" not in name]  # which choose among finite actions
    command = commands.add_parser(
        "demo",
        help="train a car to keep its lane, then drive the unseen tracks",
        description="Trains on one track, drives one lap of each of the paper's four test tracks with the actor alone, "
        "prints a table, and leaves model.zip, run.json, training.csv, evaluation.json, learning_curve.png, "
        "predictor.png and lap.gif in the output folder.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--algo", choices=steering, default=default.algo, help="the algorithm")
    command.add_argument(
        "--preset", default=argparse.SUPPRESS, help="named settings of zoo_configs (default: fast, where there is one)"
    )
    command.add_argument("--steps", type=positive, default=default.steps, help="training steps")
    command.add_argument("--seed", type=not_negative, default=default.seed, help="seed of everything random")
    command.add_argument("--track", default=default.track, help="track to train on: a name, a file or random:SEED")
    _add_simulator(command)
    command.add_argument("--out", type=Path, default=default.out, help="output folder")
    command.add_argument("--animation", action=argparse.BooleanOptionalAction, default=True, help="draw lap.gif")
    command.set_defaults(run=_demo)


def _demo(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.demo import Run, demo

    demo(Run(**{name: value for name, value in vars(options).items() if name != "run"}), console)
    return 0


def _add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    from sb3_sap.benchmark.paper import TEST_TRACKS

    command = commands.add_parser(
        "evaluate",
        help="drive laps with a saved model",
        description="Drives one lap of each track with the saved policy alone, prints a table and writes it as JSON. "
        "Loading a model file or statistics runs code that they contain: load only files that you trust.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("model", type=Path, help="the .zip file of any SB3 model of the lane-keeping task")
    command.add_argument("--tracks", nargs="+", default=list(TEST_TRACKS), metavar="TRACK", help="tracks to drive")
    command.add_argument("--json", type=Path, help="where to write the results; evaluation.json beside the model")
    add_vecnormalize(command)
    _add_simulator(command)
    command.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.demo import drive_tracks, results_table
    from sb3_sap.evaluation import load_policy, write_results

    policy = load_policy(options.model, options.vecnormalize)
    if isinstance(policy, NormalisedPolicy):
        console.print(f"Observations are normalised with {policy.path}.", soft_wrap=True)
    results = drive_tracks(policy, options.tracks, options.simulator, console)
    console.print(results_table(results))
    write_results(options.json or options.model.parent / "evaluation.json", results)
    return 0


def _add_simulator(command: argparse.ArgumentParser) -> None:
    command.add_argument("--simulator", choices=list(ENVIRONMENTS), default="highway", help="what the car drives on")


if __name__ == "__main__":
    sys.exit(main())
