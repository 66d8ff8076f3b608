"""Pictures of a study."""

from __future__ import annotations

from typing import Any

import matplotlib.tri as tri
import numpy as np
import optuna
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from optuna.trial import TrialState

#: Colour levels of the contour.
LEVELS = 12
#: Points along each axis of the grid on which the contour is interpolated.
RESOLUTION = 200


def completed(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """The trials that have a value."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def history(study: optuna.Study, target: str) -> Figure:
    """The value of every trial, pruned ones at their last evaluation, and the best so far."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    done = completed(study)
    numbers, values = [trial.number for trial in done], [float(trial.value or 0) for trial in done]
    axis.plot(numbers, values, "o", color="C0", label="finished")
    axis.step(numbers, np.maximum.accumulate(values), where="post", color="C1", label="best so far")
    pruned = [t for t in study.get_trials(deepcopy=False, states=(TrialState.PRUNED,)) if t.intermediate_values]
    if pruned:
        last = [trial.intermediate_values[max(trial.intermediate_values)] for trial in pruned]
        axis.plot([trial.number for trial in pruned], last, "x", color="0.5", label="pruned, last evaluation")
    axis.set(xlabel="trial", ylabel=target, title=study.study_name)
    axis.legend(loc="lower right")
    axis.grid(alpha=0.3)
    return figure


def importances(importance: dict[str, float]) -> Figure:
    """How much of the difference between good trials and all trials each parameter explains."""
    figure = Figure(figsize=(8, 1.2 + 0.4 * len(importance)), layout="constrained")
    axis = figure.subplots()
    names = list(importance)[::-1]
    bars = axis.barh(names, [importance[name] for name in names], color="C0")
    axis.bar_label(bars, fmt="%.2f", padding=3)
    axis.set(xlabel="importance (PED-ANOVA)", xlim=(0, 1.1))
    return figure


def contour(study: optuna.Study, x: str, y: str, target: str) -> Figure:
    """The value over two parameters: interpolated between the trials, each of which is marked."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axis = figure.subplots()
    points = [(t.params[x], t.params[y], float(t.value or 0)) for t in completed(study) if {x, y} <= t.params.keys()]
    xs, ys, values = (np.array(column, dtype=float) for column in zip(*points, strict=True))
    best = int(values.argmax())
    # A failed run or two must not take all colours; what is below is drawn in the lowest.
    low, high = np.quantile(values, 0.1), values.max()
    levels: Any = np.linspace(low, high, LEVELS) if high > low else LEVELS
    log = _is_log(study, y)
    heights = np.log(ys) if log else ys
    if _spread(xs, heights):
        grid_x, grid_y = np.meshgrid(
            np.linspace(xs.min(), xs.max(), RESOLUTION), np.linspace(heights.min(), heights.max(), RESOLUTION)
        )
        surface = tri.LinearTriInterpolator(tri.Triangulation(xs, heights), values)(grid_x, grid_y)
        filled = axis.contourf(grid_x, np.exp(grid_y) if log else grid_y, surface, levels, cmap="viridis", extend="min")
        figure.colorbar(filled, ax=axis, label=target)
    axis.scatter(xs, ys, c=values, cmap="viridis", vmin=low, vmax=high, edgecolors="k", s=28, label="trials")
    axis.plot(xs[best], ys[best], "*", color="C3", markersize=16, label=f"best, {values[best]:.3f}")
    if log:
        axis.set_yscale("log")
        axis.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if str(value)[0] in "25" else ""))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set(xlabel=x, ylabel=y, title=f"{study.study_name}: {len(points)} finished trials")
    axis.legend(loc="upper left")
    return figure


def _is_log(study: optuna.Study, name: str) -> bool:
    return any(getattr(trial.distributions.get(name), "log", False) for trial in completed(study))


def _spread(xs: Any, ys: Any) -> bool:
    """Whether points span a triangle."""
    return len(xs) > 3 and np.linalg.matrix_rank(np.stack([xs - xs.mean(), ys - ys.mean()]), tol=1e-9) == 2
