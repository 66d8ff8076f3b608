"""An animation of a driving policy, with E's probability that each steering angle is permissible."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import Progress

from sb3_sap.common.acting import Actor
from sb3_sap.common.files import atomic_path
from sb3_sap.envs import CarState
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.evaluation.predictor_plots import permissible_probability

#: Control steps of the animation (30 s of driving), and its pictures per second (twice real time).
ANIMATION_STEPS = 150
ANIMATION_FPS = 10
#: Number of steering angles of the fan that shows E's probabilities.
FAN_ANGLES = 31


def animate(policy: Any, simulator: str, speed: float, path: Path, console: Console, track: str = "g-track-3") -> None:
    """Writes a short animation of the policy on a track that it has never seen.

    Each picture shows a state, what the actor is about to do there, and E's probability for each steering angle.
    """
    from sb3_sap.envs.viewer import Viewer

    env = gym.make(ENVIRONMENTS[simulator], track=track, speed=speed)
    viewer = Viewer(env.unwrapped.simulator.track)  # type: ignore[attr-defined]
    guided = getattr(policy, "predictor", None) is not None and policy.predictor.fitted
    steering = np.linspace(-1, 1, FAN_ANGLES)[:, None]
    frames: list[Image.Image] = []
    act = Actor(policy)
    obs, info = env.reset(seed=0)
    done = False
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("animation", total=ANIMATION_STEPS)
        while not done and len(frames) < ANIMATION_STEPS:
            action = act(obs)
            fan = permissible_probability(policy, obs[None], steering)[0] if guided else None
            state = CarState(*(info[name] for name in CarState._fields))
            frames.append(Image.fromarray(viewer.draw(state, float(action[0]), fan)).quantize(64))
            obs, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            progress.advance(task)
    env.close()
    with atomic_path(path) as temporary:
        frames[0].save(temporary, save_all=True, append_images=frames[1:], duration=1000 // ANIMATION_FPS, loop=0)
