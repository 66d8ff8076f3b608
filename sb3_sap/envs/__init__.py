"""Environments. Importing this registers ``sap/LaneKeeping-v0``; simulators are imported when one is made."""

from __future__ import annotations

import os

from gymnasium.envs.registration import register

from sb3_sap.envs.constraints import constraint_ce1, constraint_ce2
from sb3_sap.envs.lane_keeping import CarState, LaneKeepingEnv, Simulator, ap_function, score
from sb3_sap.envs.tracks import TRACKS, Track, get_track

MAX_EPISODE_STEPS = 10_000
"""Enough for a lap of the longest track (Spring, 8,000 steps at 50 km/h and 0.2 s); ends episodes of ``laps=None``."""


def make_lane_keeping(
    track: str | os.PathLike[str] | Track = "wheel-2",
    speed: float = 50.0,
    control_step: float = 0.2,
    laps: int | None = 1,
    random_start: bool = False,
    render_mode: str | None = None,
) -> LaneKeepingEnv:
    """Make `LaneKeepingEnv` on the embedded simulator: what ``gym.make("sap/LaneKeeping-v0", …)`` calls.

    :param track: as `get_track` takes it
    :param speed: default speed, km/h
    :param control_step: s between two actions
    :param laps: laps to drive, or None to drive on
    :param random_start: start anywhere on the track instead of at the line
    :param render_mode: None, "rgb_array" or "human"
    """
    from sb3_sap.envs.highway import HighwaySimulator

    simulator = HighwaySimulator(track, speed, control_step)
    return LaneKeepingEnv(simulator, laps=laps, random_start=random_start, render_mode=render_mode)


make_lane_keeping.metadata = LaneKeepingEnv.metadata  # type: ignore[attr-defined]  # gym.make asks it for render modes

register("sap/LaneKeeping-v0", "sb3_sap.envs:make_lane_keeping", max_episode_steps=MAX_EPISODE_STEPS)

__all__ = [
    "TRACKS",
    "CarState",
    "LaneKeepingEnv",
    "Simulator",
    "Track",
    "ap_function",
    "constraint_ce1",
    "constraint_ce2",
    "get_track",
    "make_lane_keeping",
    "score",
]
