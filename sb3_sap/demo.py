"""The main job in one command: learn on one track, drive the unseen ones, show what happened."""

from __future__ import annotations

import json
import shlex
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from PIL import Image
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap import plots
from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.beliefs import permissible_probability
from sb3_sap.benchmark.paper import TABLE_2, TEST_TRACKS, paper_score
from sb3_sap.envs import TRACKS, CarState
from sb3_sap.evaluation import ENVIRONMENTS, LapResult, drive_lap, write_results
from sb3_sap.files import atomic_path
from sb3_sap.hub import EXTRAS
from sb3_sap.presets import preset, preset_names

#: km/h, the default speed of the task.
SPEED = 50.0
#: Control steps shown in the animation (30 s of driving), and pictures per second: twice real time.
ANIMATION_STEPS = 150
ANIMATION_FPS = 10
#: Steering angles of the fan that shows E's verdict.
FAN_ANGLES = 31


@dataclass
class Run:
    """What to train, where, and where to leave the results."""

    algo: str = "ddpg_ap"
    preset: str | None = None  # "fast" where there is one, else "default"
    steps: int = 3_000
    seed: int = 0
    track: str = "wheel-2"
    simulator: str = "highway"
    out: Path = field(default_factory=lambda: Path("demo_output"))
    animation: bool = True

    @property
    def command(self) -> str:
        """The command that does the same again."""
        given = {name: getattr(self, name) for name in ("algo", "preset", "steps", "seed", "track", "simulator")}
        words = [word for name, value in given.items() if value is not None for word in (f"--{name}", str(value))]
        return shlex.join(["sb3-sap", "demo", *words])


class TrainingLog(BaseCallback):
    """Collects one row of a tidy table for every training step, and ends the training when it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []
        self.stop = False

    def _on_step(self) -> bool:
        [info], [reward] = self.locals["infos"], self.locals["rewards"]
        self.rows.append(
            {
                "step": self.num_timesteps,
                "episode": self.model._episode_num,
                "reward": float(reward),
                "permissible": info["permissible"],
                "off_track": info["off_track"],
                "track_pos": info["track_pos"],
                "validation_accuracy": getattr(self.model, "validation_accuracy", float("nan")),
                "alpha": getattr(self.model, "current_alpha", float("nan")),
            }
        )
        return not self.stop


@contextmanager
def ctrl_c_stops(log: TrainingLog) -> Iterator[None]:
    """Ends the training after the step in which Ctrl-C was pressed, and only then interrupts.

    An exception in the middle of a step can be lost in a destructor, or leave a buffer half written.
    """

    def stop(*_: object) -> None:
        log.stop = True

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if log.stop:
        raise KeyboardInterrupt


def demo(run: Run, console: Console) -> list[LapResult]:
    """Trains, drives the test tracks and leaves model, tables and pictures in ``run.out``."""
    env = gym.make(ENVIRONMENTS[run.simulator], track=run.track, laps=None, speed=SPEED)
    name = run.preset or ("fast" if "fast" in preset_names(run.algo) else "default")
    settings = preset(name, run.algo, run.steps)
    model = ALGORITHMS[run.algo]("MlpPolicy", env, seed=run.seed, **settings)
    log = TrainingLog()
    try:
        with ctrl_c_stops(log):
            console.print(
                f"[bold]{type(model).__name__}[/] learns {run.steps:,} steps on {run.track} (preset {name!r})"
            )
            model.learn(run.steps, callback=log, progress_bar=console.is_terminal)
    finally:
        # Ctrl-C included: what was learned so far stays, but not what an earlier run left of another model.
        for name in EXTRAS:
            (run.out / name).unlink(missing_ok=True)
        with atomic_path(run.out / "model.zip") as temporary:
            model.save(temporary)
        with atomic_path(run.out / "run.json") as temporary:
            taken = len(log.rows)
            command = run.command if taken >= run.steps else f"{run.command}  # interrupted after {taken} steps"
            described = {**asdict(run), "out": str(run.out), "command": command}
            temporary.write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
        training = pd.DataFrame(log.rows)
        with atomic_path(run.out / "training.csv") as temporary:
            training.to_csv(temporary, index=False)
    results = drive_tracks(model, list(TEST_TRACKS), run.simulator, console)
    write_results(run.out / "evaluation.json", results)
    console.print(results_table(results, run.algo, run.steps))
    draw(run, model, training)
    if run.animation:
        animate(model, run, console)
    console.print(f"Model, tables and pictures are in [bold]{run.out}/[/]")
    return results


def drive_tracks(policy: Any, tracks: list[str], simulator: str, console: Console) -> list[LapResult]:
    """Drives one lap of each track, showing progress."""
    with Progress(console=console, transient=True) as progress:
        return [drive_lap(policy, track, simulator, progress) for track in tracks]


def results_table(results: list[LapResult], algo: str | None = None, steps: int = 3_000) -> Table:
    """The results as the paper's Table 2 shows them, beside its own row of the same algorithm where there is one."""
    paper = TABLE_2.get(steps, TABLE_2[3_000]).get(algo or "", {})
    title = "One lap of each track, the actor alone"
    if paper:
        title += f"; the paper's, after {steps if steps in TABLE_2 else 3_000:,} steps, beside it"
    table = Table(title=title)
    for name in ("track", "lap done", "covered", "total reward", "score S"):
        table.add_column(name, justify="left" if name == "track" else "right", no_wrap=name == "track")
    if paper:
        table.add_column("paper: covered", justify="right", style="dim")
        table.add_column("S", justify="right", style="dim")
    for result in results:
        row = [
            TRACKS.get(result.track, result.track),
            "yes" if result.lap_done else "no",
            f"{result.covered:.1%}",
            f"{result.total_reward:,.0f}",
            f"{result.score:.3f}",
        ]
        if result.track in paper:
            lap = paper[result.track]
            row += [f"{lap.covered:.1%}", f"{paper_score(result.track, lap.total_reward):.3f}"]
        table.add_row(*row)
    return table


def draw(run: Run, model: Any, training: pd.DataFrame) -> None:
    """Draws the learning curve and, where there is a fitted predictor, what it believes."""
    title = f"{type(model).__name__} on {TRACKS.get(run.track, run.track)}, seed {run.seed}"
    plots.save(
        plots.learning_curve(training, title, getattr(model, "noise_steps", None)), run.out / "learning_curve.png"
    )
    predictor = getattr(model, "predictor", None)
    if predictor is not None and predictor.fitted:
        plots.save(plots.predictor_beliefs(model, SPEED), run.out / "predictor.png")


def animate(policy: Any, run: Run, console: Console, track: str = "g-track-3") -> None:
    """Writes a short animation of the policy on a track that it has never seen.

    Each picture shows a state, what the actor is about to do there, and E's verdict on every steering angle.
    """
    from sb3_sap.envs.viewer import Viewer

    env = gym.make(ENVIRONMENTS[run.simulator], track=track, speed=SPEED)
    viewer = Viewer(env.unwrapped.simulator.track)  # type: ignore[attr-defined]
    guided = getattr(policy, "predictor", None) is not None and policy.predictor.fitted
    steering = np.linspace(-1, 1, FAN_ANGLES)[:, None]
    frames: list[Image.Image] = []
    obs, info = env.reset(seed=0)
    done = False
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("animation", total=ANIMATION_STEPS)
        while not done and len(frames) < ANIMATION_STEPS:
            action, _ = policy.predict(obs, deterministic=True)
            fan = permissible_probability(policy, obs[None], steering)[0] if guided else None
            state = CarState(*(info[name] for name in CarState._fields))
            frames.append(Image.fromarray(viewer.draw(state, float(action[0]), fan)).quantize(64))
            obs, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            progress.advance(task)
    env.close()
    with atomic_path(run.out / "lap.gif") as temporary:
        frames[0].save(temporary, save_all=True, append_images=frames[1:], duration=1000 // ANIMATION_FPS, loop=0)
