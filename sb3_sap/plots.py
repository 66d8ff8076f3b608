"""Pictures of a training run and of what the predictor believes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th
from matplotlib.figure import Figure

from sb3_sap.envs.lane_keeping import OBSERVATION_SCALE
from sb3_sap.files import atomic_path

#: Steps of the moving average of Fig. 4(a).
WINDOW = 100
#: Points along each axis of the predictor's picture.
RESOLUTION = 121
DPI = 120


def save(figure: Figure, path: Path) -> None:
    """Writes a figure in the format of the path's suffix."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI)


def learning_curve(training: pd.DataFrame, title: str, t_k: int | None = None) -> Figure:
    """Average reward over the last 100 steps (Fig. 4a) and, where there is a predictor, its accuracy (Fig. 5).

    :param training: columns ``step``, ``reward``, ``off_track`` and ``validation_accuracy``
    :param t_k: marked, if given
    """
    guided = training["validation_accuracy"].notna().any()
    figure = Figure(figsize=(8, 6 if guided else 3.6), layout="constrained")
    axes = figure.subplots(2 if guided else 1, 1, sharex=True, squeeze=False)[:, 0]
    top = axes[0]
    average = training["reward"].rolling(WINDOW, min_periods=1).mean()
    top.plot(training["step"], average, color="C0", label=f"average reward over {WINDOW} steps")
    left = training[training["off_track"]]
    if len(left):
        top.plot(left["step"], average[left.index], "x", color="C3", label=f"left the road ({len(left)}×)")
    top.set_ylabel("reward per step [km/h]")
    top.set_title(title)
    if guided:
        axes[1].plot(training["step"], training["validation_accuracy"], color="C2", linewidth=0.8, alpha=0.4)
        smooth = training["validation_accuracy"].rolling(WINDOW, min_periods=1).mean()
        axes[1].plot(training["step"], smooth, color="C2", label="balanced validation accuracy of the AP predictor")
        axes[1].axhline(0.7, color="0.5", linestyle=":", label="α gate (70 %)")
        axes[1].set(ylabel="accuracy", ylim=(0, 1.02))
    for axis in axes:
        if t_k:
            axis.axvline(t_k, color="0.5", linestyle="--", label=f"guidance begins ($t_k$ = {t_k})")
        axis.legend(loc="lower right")
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("training step")
    return figure


def predictor_beliefs(model: Any, speed: float) -> Figure:
    """The predictor's probability that a steering action is permissible, over trackPos and over angle.

    :param model: a guided lane-keeping model
    :param speed: km/h
    """
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    steering = np.linspace(-1, 1, RESOLUTION)
    # On the axis itself Eq. (6) forbids almost everything, so the angle is swept beside it.
    beside = 0.3
    sweeps = (
        (1, 1.0, 0.0, "trackPos (+1 left edge), car aligned with the road"),
        (0, 0.5, beside, f"angle [rad] (+ points right), car at trackPos {beside}"),
    )
    for axis, (variable, limit, track_pos, label) in zip(axes, sweeps, strict=True):
        values = np.linspace(-limit, limit, RESOLUTION)
        raw = np.zeros((RESOLUTION, 5))
        raw[:, 1], raw[:, 2] = track_pos, speed
        raw[:, variable] = values
        obs = (raw / OBSERVATION_SCALE).astype(np.float32)
        image = axis.pcolormesh(
            values, steering, permissible_probability(model, obs, steering).T, cmap="RdYlGn", vmin=0, vmax=1
        )
        axis.plot(values, model.predict(obs, deterministic=True)[0][:, 0], color="k", linewidth=2, label="the actor")
        axis.set(xlabel=label, ylim=(-1, 1))
        axis.legend(loc="upper right")
    axes[0].set_ylabel("steering (+1 full left)")
    figure.colorbar(image, ax=axes, label="E: probability of permissible")
    figure.suptitle(f"What the AP predictor believes at {speed:g} km/h")
    return figure


@th.no_grad()
def permissible_probability(model: Any, obs: np.ndarray[Any, Any], actions: np.ndarray[Any, Any]) -> Any:
    """E's probability for every pair of n observations and m one-dimensional scaled actions: (n, m)."""
    features = model.predictor.features(th.as_tensor(obs, device=model.device))
    pairs = th.as_tensor(actions, dtype=th.float32, device=model.device).repeat(len(obs))[:, None]
    logits = model.predictor.logits(features.repeat_interleave(len(actions), dim=0), pairs)
    return th.sigmoid(logits).cpu().numpy().reshape(len(obs), len(actions))
