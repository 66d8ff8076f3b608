"""A lap against the clock, recorded, and its picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sb3_sap.envs.tracks import Track
from sb3_sap.envs.units import KMH
from sb3_sap.evaluation.laps import drive

RACING = "sap/TorcsRacing-v0"
#: Distance between two drawn points of the road's edges, m.
EDGE_STEP = 5.0


@dataclass(frozen=True)
class RaceLap:
    """One lap from the grid, or the part of it that was driven."""

    track: Track
    lap_time: float | None  # s
    covered: float  # fraction of the lap
    steps: pd.DataFrame  # of each step: time_s, progress_m from the start, distance_m, track_pos, speed_kmh

    @property
    def mean_speed(self) -> float:
        """km/h along the centre line."""
        last = self.steps.iloc[-1]
        return float(last["progress_m"] / last["time_s"] * KMH)


def race(policy: Any, track: str, **options: Any) -> RaceLap:
    """Drives one lap from the grid.

    :param policy: a model or policy with SB3's ``predict``
    :param track: name of a track that TORCS ships, or the path of a track file
    :param options: of ``sap/TorcsRacing-v0``
    """
    env = gym.make(RACING, track=track, laps=1, **options)
    driven: Any = env.unwrapped
    try:
        rows, info = [], dict[str, Any]()
        for _, info in drive(policy, env):
            progress = info["covered"] * driven.length
            rows.append((info["time"], progress, info["distance"], info["track_pos"], info["speed_x"]))
        columns = ["time_s", "progress_m", "distance_m", "track_pos", "speed_kmh"]
        times = info["lap_times"]
        return RaceLap(driven.track, times[0] if times else None, info["covered"], pd.DataFrame(rows, columns=columns))
    finally:
        env.close()


def lap_figure(laps: Mapping[str, RaceLap]) -> Figure:
    """The path of the first lap on its track, coloured by speed, and below it the speed of every lap.

    :param laps: on one track, by the name of the driver
    :raise ValueError: if there is none
    """
    if not laps:
        raise ValueError("`laps` is empty: give at least one lap, {name: race(policy, track)}.")
    first = next(iter(laps.values()))
    figure = Figure(figsize=(8, 8.5), layout="constrained")
    plan, profile = figure.subplots(2, 1, height_ratios=[2, 1])
    _draw_road(plan, first.track)
    path = _points(first.track, first.steps["distance_m"].to_numpy(), first.steps["track_pos"].to_numpy())
    line = LineCollection(list(np.stack([path[:-1], path[1:]], axis=1)), cmap="viridis", linewidths=2.5)
    line.set_array(first.steps["speed_kmh"].to_numpy()[1:])
    plan.add_collection(line)
    figure.colorbar(line, ax=plan, label="km/h", shrink=0.8)
    plan.set(
        aspect="equal", xlabel="m", ylabel="m", title=f"{first.track.name}, {_described(*next(iter(laps.items())))}"
    )
    for name, lap in laps.items():
        steps = lap.steps
        profile.plot(steps["progress_m"], steps["speed_kmh"], linewidth=1.2, label=_described(name, lap))
    profile.set(xlabel="progress from the start [m]", ylabel="speed [km/h]", ylim=(0, None))
    profile.legend(loc="lower right")
    profile.grid(alpha=0.3)
    return figure


def _described(name: str, lap: RaceLap) -> str:
    if lap.lap_time is None:
        return f"{name}: {lap.covered:.0%} of the lap"
    return f"{name}: {lap.lap_time:.1f} s, {lap.mean_speed:.0f} km/h"


def _draw_road(axis: Any, track: Track) -> None:
    along = np.append(np.arange(0.0, track.length, EDGE_STEP), track.length - 1e-6)
    left, right = (_points(track, along, np.full(len(along), side)) for side in (1.0, -1.0))
    for edge in (left, right):
        axis.plot(*edge.T, color="0.55", linewidth=0.8)
    axis.plot(*np.stack([left[0], right[0]]).T, color="0.2", linewidth=2, label="start line")


def _points(track: Track, distance: NDArray[Any], track_pos: NDArray[Any]) -> NDArray[np.float64]:
    """Places in the plane, (n, 2) m."""
    half = track.width / 2
    return np.array([track.position(d, pos * half)[:2] for d, pos in zip(distance, track_pos, strict=True)])
