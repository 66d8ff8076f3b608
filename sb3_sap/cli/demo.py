"""``sb3-sap demo``: learn on one track, drive unseen tracks, draw what happened."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import pandas as pd
from rich.console import Console

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.cli.animation import animate
from sb3_sap.cli.hub import EXTRAS
from sb3_sap.cli.laps import drive_tracks, results_table
from sb3_sap.cli.racing_demo import RacingRun, racing_demo
from sb3_sap.cli.training_log import TrainingLog, ctrl_c_stops
from sb3_sap.common.command_line import not_negative, positive
from sb3_sap.common.files import atomic_path
from sb3_sap.envs import TRACKS
from sb3_sap.evaluation.lane_keeping_plots import learning_curve, predictor_probabilities
from sb3_sap.evaluation.laps import ENVIRONMENTS, LapResult, write_results
from sb3_sap.evaluation.plots import save
from sb3_sap.presets import preset, preset_names

#: Speed of the car, km/h (the default of the task).
SPEED = 50.0


@dataclass
class Run:
    """Settings of a demonstration."""

    algo: str = "ddpg_ap"
    preset: str | None = None  # "fast" where there is one, else "default"
    steps: int = 3_000
    seed: int = 0
    track: str = "wheel-2"
    simulator: str = "highway"
    out: Path = field(default_factory=lambda: Path("demo_output"))
    animation: bool = True
    predictor: Path | None = None  # an AP predictor to begin with

    @property
    def command(self) -> str:
        """The command that does the same again."""
        given = {
            name: getattr(self, name) for name in ("algo", "preset", "steps", "seed", "track", "simulator", "predictor")
        }
        words = [word for name, value in given.items() if value is not None for word in (f"--{name}", str(value))]
        return shlex.join(["sb3-sap", "demo", *words])


def demo(run: Run, console: Console) -> list[LapResult]:
    """Trains, drives the test tracks and leaves model, tables and pictures in ``run.out``."""
    env = gym.make(ENVIRONMENTS[run.simulator], track=run.track, laps=None, speed=SPEED)
    name = run.preset or ("fast" if "fast" in preset_names(run.algo) else "default")
    settings = preset(name, run.algo, run.steps)
    if run.predictor is not None:
        settings["predictor"] = run.predictor
    model = ALGORITHMS[run.algo]("MlpPolicy", env, seed=run.seed, **settings)
    log = TrainingLog()
    try:
        with ctrl_c_stops(log):
            console.print(
                f"[bold]{type(model).__name__}[/] learns {run.steps:,} steps on {run.track} (preset {name!r})"
            )
            model.learn(run.steps, callback=log, progress_bar=console.is_terminal)
    finally:
        # After Ctrl-C, too, the model is saved, and files of an earlier run of another model are removed.
        for name in EXTRAS:
            (run.out / name).unlink(missing_ok=True)
        with atomic_path(run.out / "model.zip") as temporary:
            model.save(temporary)
        if hasattr(model, "save_predictor"):
            model.save_predictor(run.out / "predictor.pt")
        with atomic_path(run.out / "run.json") as temporary:
            taken = len(log.rows)
            command = run.command if taken >= run.steps else f"{run.command}  # interrupted after {taken} steps"
            described = {
                **asdict(run),
                "out": str(run.out),
                "predictor": run.predictor and str(run.predictor),
                "command": command,
            }
            temporary.write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
        training = pd.DataFrame(log.rows)
        with atomic_path(run.out / "training.csv") as temporary:
            training.to_csv(temporary, index=False)
    results = drive_tracks(model, list(TEST_TRACKS), run.simulator, console)
    write_results(run.out / "evaluation.json", results)
    console.print(results_table(results, run.algo, run.steps))
    draw(run, model, training)
    if run.animation:
        animate(model, run.simulator, SPEED, run.out / "lap.gif", console)
    console.print(f"Model, tables and pictures are in [bold]{run.out}/[/]")
    return results


def draw(run: Run, model: Any, training: pd.DataFrame) -> None:
    """Draws the learning curve and, where there is a fitted predictor, its probabilities."""
    title = f"{type(model).__name__} on {TRACKS.get(run.track, run.track)}, seed {run.seed}"
    save(learning_curve(training, title, getattr(model, "noise_steps", None)), run.out / "learning_curve.png")
    predictor = getattr(model, "predictor", None)
    if predictor is not None and predictor.fitted:
        save(predictor_probabilities(model, SPEED), run.out / "predictor.png")


#: Options that only lane keeping has.
LANE_KEEPING_ONLY = ("preset", "simulator", "predictor", "animation")


def add_demo(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds ``sb3-sap demo``."""
    default, racing = Run(), RacingRun()
    steering = [name for name, algorithm in ALGORITHMS.items() if not cast(Any, algorithm).discrete]
    command = commands.add_parser(
        "demo",
        help="train a car to keep its lane, then drive the unseen tracks; or to race",
        description="Trains on one track, drives one lap of each of the paper's four test tracks with the actor alone, "
        "prints a table, and leaves model.zip, predictor.pt, run.json, training.csv, evaluation.json, "
        "learning_curve.png, predictor.png and lap.gif in the output folder. With --task racing, on TORCS, the policy "
        "imitates what was permissible in a scripted driver's log; its lap and the driver's are left as lap.png "
        "and laps.csv.",
        argument_default=argparse.SUPPRESS,  # the tasks have different defaults
    )
    command.add_argument("--task", choices=("lane-keeping", "racing"), help="what to learn (default: lane-keeping)")

    def add(name: str, text: str, **settings: Any) -> None:
        own, raced = getattr(default, name), getattr(racing, name, None)
        shown = f"{own}; racing: {raced}" if raced not in (None, own) else f"{own}"
        command.add_argument(f"--{name}", help=f"{text} (default: {shown})", **settings)

    add("algo", "the algorithm", choices=steering)
    command.add_argument("--preset", help="named settings of zoo_configs (default: fast, where there is one)")
    add("steps", "training steps, for racing after the imitation", type=positive)
    add("seed", "seed of everything random", type=not_negative)
    add("track", "track to train on: a name, a file or, on the embedded simulator, random:SEED")
    add("simulator", "what the car drives on", choices=list(ENVIRONMENTS))
    add("out", "output folder", type=Path)
    text = "an AP predictor to begin with, such as predictor.pt of an earlier run"
    command.add_argument("--predictor", type=Path, metavar="FILE", help=text)
    command.add_argument("--animation", action=argparse.BooleanOptionalAction, help="draw lap.gif (default: yes)")
    command.set_defaults(run=_demo)


def _demo(options: argparse.Namespace, console: Console) -> int:
    given = {name: value for name, value in vars(options).items() if name != "run"}
    if given.pop("task", None) != "racing":
        demo(Run(**given), console)
        return 0
    for name in given:
        if name in LANE_KEEPING_ONLY:
            raise ValueError(f"`--task racing` has no --{name}: leave it out.")
    racing_demo(RacingRun(**given), console)
    return 0
