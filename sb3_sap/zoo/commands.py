"""The commands: rl_zoo3's own, called with our algorithms, our ExperimentManager and our flags."""

from __future__ import annotations

import runpy
import shlex
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import rl_zoo3.enjoy
import rl_zoo3.train
import rl_zoo3.utils

from sb3_sap.errors import nearest
from sb3_sap.zoo.configs import check_algo
from sb3_sap.zoo.options import StudyOptions, study_parser
from sb3_sap.zoo.registration import register, small_buffers
from sb3_sap.zoo.report import write_report_to
from sb3_sap.zoo.retest import RetestManager
from sb3_sap.zoo.storages import load_study
from sb3_sap.zoo.tuning import StudyManager

DEFAULT_ALGO = "ddpg_ap"
LOGS = "logs"
#: Base seeds where `--seed` is missing. Studies stay clear of the benchmark's seeds, and fresh seeds of a study's.
SEEDS = {"optimize": 100, "retest": 10_000}
PLOTS = ("train", "all", "file", "study")


def run(arguments: list[str]) -> int:
    """Runs ``[command, *flags]``."""
    if not arguments or arguments[0] not in RUNNERS:
        known = ", ".join(RUNNERS)
        raise ValueError(f"{f'{arguments[0]!r} is no command' if arguments else 'A command is missing'}: {known}.")
    register()
    try:
        RUNNERS[arguments[0]](arguments[0], arguments[1:])
    except AssertionError as error:
        # rl_zoo3 says so of what it does not find.
        raise ValueError(str(error) or "rl_zoo3 gave up without a reason.") from error
    return 0


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
    with _argv(command, rest):
        zoo.train()


def _with_defaults(command: str, rest: list[str], given: Namespace) -> list[str]:
    if given.algo is None:
        rest = [*rest, "--algo", DEFAULT_ALGO]
    if command != "train":
        rest = [*rest, "-optimize"]
    seed = SEEDS.get(command)
    if given.trial_id is not None and given.storage and given.study_name:
        # A replay is one of the seed as well.
        trials = {t.number: t for t in load_study(given.storage, given.study_name).get_trials(deepcopy=False)}
        seed = trials[given.trial_id].user_attrs.get("seed") if given.trial_id in trials else None
    return rest if given.seed is not None or seed is None else [*rest, "--seed", str(seed)]


def _given(rest: list[str]) -> Namespace:
    """Those of RL Zoo's flags that have to be known beforehand."""
    parser = ArgumentParser(prog="sb3-sap", usage="sb3-sap COMMAND [flags]", add_help=False, allow_abbrev=False)
    for flag in ("--algo", "--storage", "--study-name"):
        parser.add_argument(flag)
    for flag in ("--seed", "--trial-id"):
        parser.add_argument(flag, type=int)
    return parser.parse_known_args(rest)[0]


def _watch(command: str, arguments: list[str]) -> None:
    algo = _given(arguments).algo
    check_algo(algo or DEFAULT_ALGO)
    arguments = arguments if algo else [*arguments, "--algo", DEFAULT_ALGO]
    if not any(argument in ("-f", "--folder") for argument in arguments):
        arguments = [*arguments, "-f", LOGS]  # where `train` leaves its runs; rl_zoo3's own agents are elsewhere
    zoo: Any = rl_zoo3.enjoy
    zoo.StoreDict = rl_zoo3.utils.StoreDict = NamedStoreDict  # type: ignore[misc]
    with small_buffers(), _argv(command, arguments):
        if command == "enjoy":
            zoo.enjoy()
        else:
            runpy.run_module("rl_zoo3.record_video", run_name="__main__")  # it has no function to call


def _plot(command: str, arguments: list[str]) -> None:
    if not arguments or arguments[0] not in PLOTS:
        raise ValueError(f"`plot` needs to know what: {nearest(arguments[0] if arguments else '', PLOTS)}")
    what, rest = arguments[0], arguments[1:]
    parser = ArgumentParser(prog=f"sb3-sap plot {what}", add_help=what == "study", allow_abbrev=False)
    if what == "study":
        parser.add_argument("--storage", required=True, help="where the study is kept")
        parser.add_argument("--study-name", required=True, help="its name")
        parser.add_argument("--out", type=Path, default=Path("report"), help="folder of the report")
        options = parser.parse_args(rest)
        print(f"The report is in {write_report_to(load_study(options.storage, options.study_name), options.out)}")
        return
    parser.add_argument("--save-figures", type=Path, metavar="FOLDER", help="write the figures as PNG, open no window")
    own, rest = parser.parse_known_args(rest)
    if {"-h", "--help"} & set(rest):
        parser.print_help()
    _rl_zoo3_plot(what, rest, own.save_figures)


def _rl_zoo3_plot(what: str, arguments: list[str], folder: Path | None) -> None:
    import matplotlib

    if folder:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from rl_zoo3.plots import all_plots, plot_from_file, plot_train

    from sb3_sap.plots import save

    if folder:
        plt.show = lambda *args, **kwargs: None
    with _argv(f"plot {what}", arguments):
        plots: dict[str, Any] = {"train": plot_train, "all": all_plots, "file": plot_from_file}
        plots[what]()
    for number in plt.get_fignums() if folder else []:
        save(plt.figure(number), folder / f"{what}_{number}.png")  # type: ignore[operator]


#: rl_zoo3's own; ours takes its name there.
STORE_DICT: Any = rl_zoo3.utils.StoreDict


class NamedStoreDict(STORE_DICT):  # type: ignore[misc]
    """``key:value`` pairs whose values are Python; says which one is not."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        for pair in values:
            key, colon, value = pair.partition(":")
            try:
                super().__call__(parser, namespace, [pair], option_string)
            except Exception as error:
                quoted = f"{key}:\"'{value}'\"" if colon else "alpha:0.7"
                parser.error(f"{option_string} {pair}: {value!r} is no Python ({error}); write it like {quoted}")
        super().__call__(parser, namespace, values, option_string)


@contextmanager
def _argv(command: str, arguments: list[str]) -> Iterator[None]:
    # rl_zoo3 reads the command line from here and nowhere else.
    before, sys.argv = sys.argv, [f"sb3-sap {command}", *arguments]
    try:
        yield
    finally:
        sys.argv = before


RUNNERS: dict[str, Callable[[str, list[str]], None]] = {
    "train": _train,
    "optimize": _train,
    "retest": _train,
    "enjoy": _watch,
    "record-video": _watch,
    "plot": _plot,
}
