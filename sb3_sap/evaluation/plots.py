"""Pictures of training runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3.common.monitor import Monitor, load_results

from sb3_sap.common.files import atomic_path

#: Number of points at which the mean over several runs is drawn.
POINTS = 200
#: Resolution of saved figures, dots per inch.
DPI = 120


def save(figure: Figure, path: Path) -> None:
    """Writes a figure in the format of the path's suffix."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI)


def return_curves(runs: Mapping[str, str | Path | Sequence[str | Path]], window: int = 10) -> Figure:
    """Return per episode against training steps, of runs in environments wrapped in SB3's ``Monitor``.

    :param runs: for each name in the legend what ``Monitor`` was given as its file name, or a folder of such files; or
        several of them, of runs with different seeds: then their mean is drawn, and each of them faintly
    :param window: episodes of the moving average
    """
    if not runs:
        raise ValueError("`runs` is empty: give a name and what `Monitor` wrote, {name: folder}.")
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    for number, (name, folders) in enumerate(runs.items()):
        colour = f"C{number}"
        curves = []
        for folder in [folders] if isinstance(folders, (str, Path)) else folders:
            episodes = _episodes(Path(folder))
            if episodes.empty:
                raise ValueError(f"The run {folder} has not finished an episode yet: there is no return to draw.")
            steps = episodes["l"].cumsum().to_numpy()
            curves.append((steps, episodes["r"].rolling(window, min_periods=1).mean().to_numpy()))
        if len(curves) > 1:
            for steps, average in curves:
                axis.plot(steps, average, color=colour, alpha=0.3, linewidth=0.8)
        # The mean is taken over the steps that every run has done.
        grid = np.linspace(max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves), POINTS)
        mean = np.mean([np.interp(grid, steps, average) for steps, average in curves], axis=0)
        axis.plot(grid, mean, color=colour, linewidth=2, label=name)
    axis.set(xlabel="training step", ylabel=f"return, average of {window} episodes")
    axis.legend()
    axis.grid(alpha=0.3)
    return figure


def _episodes(path: Path) -> pd.DataFrame:
    if path.is_dir():
        return load_results(str(path))
    # Monitor appends this where it is missing.
    file = path if path.name.endswith(Monitor.EXT) else path.with_name(f"{path.name}.{Monitor.EXT}")
    if not file.is_file():
        raise FileNotFoundError(f"There is neither a folder {path} nor a file {file}, as SB3's Monitor writes them.")
    return pd.read_csv(file, skiprows=1)
