"""Flags of this package, beside those of RL Zoo."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path

from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.evaluation.laps import ENVIRONMENTS


@dataclass
class StudyOptions:
    """Settings of a study beyond RL Zoo's flags."""

    guidance_only: bool = False
    validation_tracks: list[str] = field(default_factory=list)
    heartbeat: int = 60  # s
    worker: bool = False  # started by a command with `--n-jobs`, which writes the report
    best: int = 3
    runs: int = 10
    tracks: list[str] = field(default_factory=list)
    out: Path | None = None
    command: str = ""  # as typed, for the report


def study_parser(command: str) -> argparse.ArgumentParser:
    """The parser of this package's flags; RL Zoo parses its own."""
    default = StudyOptions()
    parser = argparse.ArgumentParser(
        prog=f"sb3-sap {command}", usage=f"sb3-sap {command} [flags]", add_help=False, allow_abbrev=False
    )
    group = parser.add_argument_group("flags of sb3-sap")
    group.add_argument("--guidance-only", action="store_true", help="tune alpha and t_k alone")
    group.add_argument(
        "--validation-tracks",
        nargs="+",
        default=[],
        metavar="TRACK",
        help="lane keeping: tune for the mean score S of one lap of each of these tracks, instead of the reward",
    )
    group.add_argument(
        "--heartbeat",
        type=int,
        default=default.heartbeat,
        metavar="SECONDS",
        help="a worker that gives no sign of life for twice as long is considered dead, and its trial is run again",
    )
    group.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    if command == "retest":
        group.add_argument("--best", type=int, default=default.best, help="how many of the best trials to train again")
        group.add_argument("--runs", type=int, default=default.runs, help="seeds for each of them, counted from --seed")
        group.add_argument(
            "--tracks",
            nargs="+",
            default=[],
            metavar="TRACK",
            help="lane keeping: compare on one lap of each of these tracks, instead",
        )
        group.add_argument("--out", type=Path, help="folder of retest.csv and retest.md")
    return parser


def check_validation_tracks(tracks: list[str], env_id: str) -> None:
    """Checks that the benchmark does not test on the tracks, and that the environment has tracks."""
    if tracks and env_id not in ENVIRONMENTS.values():
        raise ValueError(f"`--validation-tracks` needs one of {', '.join(ENVIRONMENTS.values())}, not {env_id}.")
    for track in tracks:
        if track in TEST_TRACKS:
            raise ValueError(
                f"`--validation-tracks` names {track!r}, one of the paper's test tracks: what is tuned on them cannot "
                "be measured on them any more, so choose another."
            )
