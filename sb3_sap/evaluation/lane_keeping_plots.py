"""Pictures of the lane-keeping task: a training run (Figs. 4a and 5) and what the predictor learned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_sap.envs.lane_keeping import OBSERVATION_SCALE
from sb3_sap.evaluation.predictor_plots import RESOLUTION, draw_permissibility
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY

#: Steps of the moving average of Fig. 4(a).
WINDOW = 100


def learning_curve(training: pd.DataFrame, title: str, t_k: int | None = None) -> Figure:
    """Average reward over the last 100 steps (Fig. 4a) and, where there is a predictor, its accuracy (Fig. 5).

    :param training: columns ``step``, ``reward``, ``off_track`` and ``validation_accuracy``
    :param t_k: timestep at which guidance begins, marked if given
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
        axes[1].axhline(SUFFICIENT_ACCURACY, color="0.5", linestyle=":", label=f"α gate ({SUFFICIENT_ACCURACY:.0%})")
        axes[1].set(ylabel="accuracy", ylim=(0, 1.02))
    for axis in axes:
        if t_k:
            axis.axvline(t_k, color="0.5", linestyle="--", label=f"guidance begins ($t_k$ = {t_k})")
        axis.legend(loc="lower right")
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("training step")
    return figure


def predictor_probabilities(model: Any, speed: float) -> Figure:
    """The predictor's probability that a steering action is permissible, over trackPos and over angle.

    :param model: a guided lane-keeping model
    :param speed: speed of the car along its axis, km/h
    """
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    # On the axis itself Eq. (6) labels almost every action non-permissible, so the angle is swept next to it.
    off_axis = 0.3
    sweeps = (
        (1, 1.0, 0.0, "trackPos (+1 left edge), car aligned with the road"),
        (0, 0.5, off_axis, f"angle [rad] (+ points right), car at trackPos {off_axis}"),
    )
    for axis, (variable, limit, track_pos, label) in zip(axes, sweeps, strict=True):
        values = np.linspace(-limit, limit, RESOLUTION)
        raw = np.zeros((RESOLUTION, 5))
        raw[:, 1], raw[:, 2] = track_pos, speed
        raw[:, variable] = values
        image = draw_permissibility(axis, model, values, (raw / OBSERVATION_SCALE).astype(np.float32))
        axis.set(xlabel=label)
    axes[0].set_ylabel("steering (+1 full left)")
    figure.colorbar(image, ax=axes, label="E: probability of permissible")
    figure.suptitle(f"Permissible according to the AP predictor at {speed:g} km/h")
    return figure
