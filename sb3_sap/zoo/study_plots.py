"""Pictures of a study."""

from __future__ import annotations

from typing import Any

import numpy as np
import optuna
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from optuna.trial import TrialState

#: Number of colour levels of the contour.
LEVELS = 12
#: Points along each axis of its grid.
RESOLUTION = 100
#: Width, as a share of a parameter's range, over which trials are averaged, because single trials are noisy.
SMOOTHING = 0.1
#: Number of trials below which most of the surface is far from any of them.
FEW = 20


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
    pruned = [trial for trial in _pruned(study) if trial.intermediate_values]
    if pruned:
        last = [trial.intermediate_values[max(trial.intermediate_values)] for trial in pruned]
        axis.plot([trial.number for trial in pruned], last, "x", color="0.5", label="pruned, last evaluation")
    axis.set(xlabel="trial", ylabel=target, title=study.study_name)
    axis.legend(loc="best")
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
    """The value over two parameters, averaged over neighbouring trials, each of which is marked."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axis = figure.subplots()
    points = [(t.params[x], t.params[y], float(t.value or 0)) for t in completed(study) if {x, y} <= t.params.keys()]
    xs, ys, values = (np.array(column, dtype=float) for column in zip(*points, strict=True))
    # A few failed runs must not take up the colour scale.
    low, high = np.quantile(values, 0.1), values.max()
    log = _is_log(study, y)
    grid_x = np.linspace(xs.min(), xs.max(), RESOLUTION)
    grid_y = (np.geomspace if log else np.linspace)(ys.min(), ys.max(), RESOLUTION)
    if low < high and len(set(xs)) > 1 and len(set(ys)) > 1:
        at_x, at_y = (
            _neighbourhood(grid_x, xs),
            _neighbourhood(*((np.log(grid_y), np.log(ys)) if log else (grid_y, ys))),
        )
        weights = at_y[:, None] * at_x[None]  # (y, x, trials)
        surface = weights @ np.maximum(values, low) / weights.sum(axis=2)
        filled = axis.contourf(grid_x, grid_y, surface, np.linspace(low, high, LEVELS), cmap="viridis")
        figure.colorbar(filled, ax=axis, label=target)
    axis.scatter(xs, ys, c=values, cmap="viridis", vmin=low, vmax=high, edgecolors="w", s=36, label="trials")
    given_up = [trial.params for trial in _pruned(study) if {x, y} <= trial.params.keys()]
    if given_up:
        axis.plot([p[x] for p in given_up], [p[y] for p in given_up], "x", color="w", label="pruned")
    best = int(values.argmax())
    axis.plot(xs[best], ys[best], "*", color="C3", markersize=16, label=f"best, {values[best]:.3f}")
    if log:
        axis.set_yscale("log")
        axis.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if str(value)[0] in "25" else ""))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set(xlabel=x, ylabel=y, title=f"{study.study_name}: {_reliability(len(points))}")
    axis.set_facecolor("0.7")
    figure.legend(loc="outside lower center", ncols=3, facecolor="0.7")
    return figure


def _reliability(n_trials: int) -> str:
    if n_trials >= FEW:
        return f"{n_trials} trials, the surface averages neighbours"
    return f"only {n_trials} trial{'s' * (n_trials != 1)}, too few to believe colours between them"


def _neighbourhood(grid: Any, positions: Any) -> Any:
    """(grid, trials) Gaussian weights, whose width is a share of the range."""
    width = SMOOTHING * np.ptp(positions)
    return np.exp(-0.5 * ((grid[:, None] - positions) / width) ** 2)


def _pruned(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(TrialState.PRUNED,))


def _is_log(study: optuna.Study, name: str) -> bool:
    return any(getattr(trial.distributions.get(name), "log", False) for trial in completed(study))
