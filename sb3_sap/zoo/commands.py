"""The commands: those of rl_zoo3, called with this package's algorithms, ExperimentManager and flags."""

from __future__ import annotations

import importlib
import runpy
import shlex
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from functools import partial
from typing import Any

import rl_zoo3.enjoy
import rl_zoo3.train
import rl_zoo3.utils

from sb3_sap.evaluation.environments import find_environment
from sb3_sap.zoo.arguments import NamedStoreDict, command_line
from sb3_sap.zoo.configs import check_algo
from sb3_sap.zoo.options import StudyOptions, study_parser
from sb3_sap.zoo.plotting import plot
from sb3_sap.zoo.registration import register, saved_env_options, small_buffers
from sb3_sap.zoo.retest import RetestManager
from sb3_sap.zoo.storages import load_study
from sb3_sap.zoo.tuning import StudyManager

#: Defaults of `--algo` and, for commands that load a run, of `--folder`.
DEFAULT_ALGO = "ddpg_ap"
LOGS = "logs"
#: Base seeds where `--seed` is missing: a study uses none of the benchmark's seeds, a retest none of the study's.
SEEDS = {"optimize": 100, "retest": 10_000}


def run(arguments: list[str]) -> int:
    """Runs ``[command, *flags]``."""
    if not arguments or arguments[0] not in RUNNERS:
        known = ", ".join(RUNNERS)
        raise ValueError(f"{f'{arguments[0]!r} is no command' if arguments else 'A command is missing'}: {known}.")
    register()
    given = _given(arguments[1:])
    for package in given.gym_packages:
        _import_environments(package)
    if given.env:
        find_environment(given.env)
    try:
        RUNNERS[arguments[0]](arguments[0], arguments[1:])
    except AssertionError as error:
        # rl_zoo3 raises an AssertionError for what it does not find.
        raise ValueError(str(error) or "rl_zoo3 gave up without a reason.") from error
    return 0


def _import_environments(package: str) -> None:
    """Imports a module of ``--gym-packages``, as rl_zoo3 does, which registers its environments."""
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise ImportError(
            f"`--gym-packages`: {package!r} cannot be imported ({error}): name a module of the current folder or of "
            "the Python path, without .py."
        ) from error


def _train(command: str, arguments: list[str]) -> None:
    parser = study_parser(command)
    if {"-h", "--help"} & set(arguments):
        parser.print_help()
        print("\nRL Zoo's own:")
    own, rest = parser.parse_known_args(arguments)
    given = _given(rest)
    rest = _with_defaults(command, rest, given)
    check_algo(given.algo or DEFAULT_ALGO)
    manager = RetestManager if command == "retest" else StudyManager
    options = StudyOptions(**vars(own), command=shlex.join(["sb3-sap", command, *arguments]))
    zoo: Any = rl_zoo3.train
    zoo.ExperimentManager, zoo.StoreDict = partial(manager, options=options), NamedStoreDict
    with command_line(command, rest):
        zoo.train()


def _with_defaults(command: str, rest: list[str], given: Namespace) -> list[str]:
    if given.algo is None:
        rest = [*rest, "--algo", DEFAULT_ALGO]
    if command != "train":
        rest = [*rest, "-optimize"]
    seed = SEEDS.get(command)
    if given.trial_id is not None and given.storage and given.study_name:
        # Replaying a trial includes its seed.
        trials = {t.number: t for t in load_study(given.storage, given.study_name).get_trials(deepcopy=False)}
        seed = trials[given.trial_id].user_attrs.get("seed") if given.trial_id in trials else None
    return rest if given.seed is not None or seed is None else [*rest, "--seed", str(seed)]


def _given(rest: list[str]) -> Namespace:
    """Parses those of RL Zoo's flags that this module needs itself."""
    parser = ArgumentParser(prog="sb3-sap", usage="sb3-sap COMMAND [flags]", add_help=False, allow_abbrev=False)
    for flag in ("--algo", "--env", "--storage", "--study-name"):
        parser.add_argument(flag)
    for flag in ("--seed", "--trial-id"):
        parser.add_argument(flag, type=int)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-f", "--folder")
    return parser.parse_known_args(rest)[0]


def _watch(command: str, arguments: list[str]) -> None:
    given = _given(arguments)
    check_algo(given.algo or DEFAULT_ALGO)
    arguments = arguments if given.algo else [*arguments, "--algo", DEFAULT_ALGO]
    if given.folder is None:
        arguments = [*arguments, "-f", LOGS]  # where `train` leaves its runs; rl_zoo3's own agents are elsewhere
    zoo: Any = rl_zoo3.enjoy
    zoo.StoreDict = rl_zoo3.utils.StoreDict = NamedStoreDict  # type: ignore[misc]
    with small_buffers(), command_line(command, arguments):
        if command == "enjoy":
            zoo.enjoy()
        else:
            with saved_env_options():
                runpy.run_module("rl_zoo3.record_video", run_name="__main__")  # it has no function to call


RUNNERS: dict[str, Callable[[str, list[str]], None]] = {
    "train": _train,
    "optimize": _train,
    "retest": _train,
    "enjoy": _watch,
    "record-video": _watch,
    "plot": plot,
}
