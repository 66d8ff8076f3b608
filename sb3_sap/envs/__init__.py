"""Environments. Importing this registers them; simulators are imported when one is made."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import register

from sb3_sap.envs.car import CarState, Simulator
from sb3_sap.envs.constraints import constraint_ce1, constraint_ce2
from sb3_sap.envs.lane_keeping import OFF_TRACK_REWARD, LaneKeepingEnv, ap_function, score
from sb3_sap.envs.tracks import TRACKS, Track, get_track

if TYPE_CHECKING:
    from sb3_sap.envs.torcs.racing import RacingEnv

#: Control steps after which an episode is truncated: enough for a lap of the longest track (Spring, 8,000 steps at
#: 50 km/h and 0.2 s).
MAX_EPISODE_STEPS = 10_000


def make_lane_keeping(
    track: str | os.PathLike[str] | Track = "wheel-2",
    speed: float = 50.0,
    control_step: float = 0.2,
    laps: int | None = 1,
    random_start: bool = False,
    off_track_reward: float = OFF_TRACK_REWARD,
    render_mode: str | None = None,
) -> LaneKeepingEnv:
    """Make `LaneKeepingEnv` on the embedded simulator: what ``gym.make("sap/LaneKeeping-v0", …)`` calls.

    :param track: as `get_track` takes it
    :param speed: default speed, km/h
    :param control_step: s between two actions
    :param laps: laps to drive, or None to drive on
    :param random_start: start anywhere on the track instead of at the line
    :param off_track_reward: reward of the step that leaves the road or turns the car backwards
    :param render_mode: None, "rgb_array" or "human"
    """
    from sb3_sap.envs.highway import HighwaySimulator

    simulator = HighwaySimulator(track, speed, control_step)
    return LaneKeepingEnv(
        simulator, laps=laps, random_start=random_start, off_track_reward=off_track_reward, render_mode=render_mode
    )


def make_torcs_lane_keeping(
    track: str | os.PathLike[str] = "wheel-2",
    speed: float = 50.0,
    control_step: float = 0.2,
    car: str = "car1-trb1",
    start: str = "training",
    laps: int | None = 1,
    random_start: bool = False,
    off_track_reward: float = OFF_TRACK_REWARD,
    render_mode: str | None = None,
) -> LaneKeepingEnv:
    """Make `LaneKeepingEnv` on TORCS: what ``gym.make("sap/TorcsLaneKeeping-v0", …)`` calls.

    :param track: name of a track that TORCS ships, or the path of a track file
    :param speed: default speed, km/h
    :param control_step: s between two actions, a multiple of 0.002
    :param car: name of a car that TORCS ships
    :param start: "training", 100 m before the line, or "race", the engine's own grid
    :param laps: laps to drive, or None to drive on
    :param random_start: start anywhere on the track
    :param off_track_reward: reward of the step that leaves the road or turns the car backwards
    :param render_mode: None, "rgb_array" or "human"
    """
    from sb3_sap.envs.torcs.simulator import TorcsSimulator

    simulator = TorcsSimulator(track, speed, control_step, car, start)
    return LaneKeepingEnv(
        simulator, laps=laps, random_start=random_start, off_track_reward=off_track_reward, render_mode=render_mode
    )


def make_torcs_driving(
    track: str | os.PathLike[str] = "wheel-2",
    control_step: float = 0.1,
    car: str = "car1-trb1",
    start: str = "training",
    laps: int | None = 1,
    random_start: bool = False,
    render_mode: str | None = None,
) -> LaneKeepingEnv:
    """Make `DrivingEnv` on TORCS: what ``gym.make("sap/TorcsDriving-v0", …)`` calls.

    The parameters are those of `make_torcs_lane_keeping`.
    """
    from sb3_sap.envs.torcs.driving import DrivingEnv
    from sb3_sap.envs.torcs.simulator import TorcsSimulator

    simulator = TorcsSimulator(track, control_step=control_step, car=car, start=start)
    return DrivingEnv(simulator, laps=laps, random_start=random_start, render_mode=render_mode)


def make_grid(task: str = "DoorKey-5x5", render_mode: str | None = None) -> gym.Env[Any, Any]:
    """Make a task of MiniGrid with labels: what ``gym.make("sap/MiniGrid-v0", …)`` calls.

    :param task: the name of the task between "MiniGrid-" and "-v0"
    :param render_mode: None, "rgb_array" or "human"
    :raise ModuleNotFoundError: if minigrid is not installed
    """
    import minigrid  # noqa: F401  # registers its tasks

    from sb3_sap.envs.grid import LabelledGrid

    return LabelledGrid(gym.make(f"MiniGrid-{task}-v0", render_mode=render_mode))


def make_torcs_racing(
    track: str | os.PathLike[str] = "wheel-2",
    control_step: float = 0.1,
    car: str = "car1-trb1",
    start: str = "race",
    laps: int | None = 1,
    random_start: bool = False,
    skill_level: int = 0,
    render_mode: str | None = None,
) -> RacingEnv:
    """Make `RacingEnv`: what ``gym.make("sap/TorcsRacing-v0", …)`` calls.

    The parameters are those of `make_torcs_lane_keeping`, and ``skill_level``, 0 (rookie) to 3 (pro): a rookie's tyres
    hold best, and only a rookie's car takes no damage.
    """
    from sb3_sap.envs.torcs.racing import RacingEnv

    return RacingEnv(track, control_step, car, start, laps, random_start, skill_level, render_mode)


for _name, _maker in {
    "sap/LaneKeeping-v0": make_lane_keeping,
    "sap/TorcsLaneKeeping-v0": make_torcs_lane_keeping,
    "sap/TorcsDriving-v0": make_torcs_driving,
    "sap/TorcsRacing-v0": make_torcs_racing,
}.items():
    _maker.metadata = LaneKeepingEnv.metadata  # type: ignore[attr-defined]  # gym.make reads the render modes from it
    register(_name, f"{__name__}:{_maker.__name__}", max_episode_steps=MAX_EPISODE_STEPS)
# A task of MiniGrid ends its own episodes.
make_grid.metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # type: ignore[attr-defined]
register("sap/MiniGrid-v0", f"{__name__}:make_grid")
# That of Gymnasium's Taxi.
register("sap/Taxi-v0", f"{__name__}.taxi:DecodedTaxi", max_episode_steps=200)

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
    "make_grid",
    "make_lane_keeping",
    "make_torcs_driving",
    "make_torcs_lane_keeping",
    "make_torcs_racing",
    "score",
]
