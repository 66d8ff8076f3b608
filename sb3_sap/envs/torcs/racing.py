"""``sap/TorcsRacing-v0``: race against the clock with steering and pedal, seeing what the SCR server's clients see."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_sap.envs.car import CarState
from sb3_sap.envs.lane_keeping import RANDOM_ANGLE, RANDOM_TRACK_POS, check_laps, check_render_mode, checked_start
from sb3_sap.envs.torcs.gearbox import Gearbox
from sb3_sap.envs.torcs.lap_clock import LapClock
from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.torcs.sensors import LIMITS, MOTION, SPINS, TRACK, UNITS, Sensors, observation
from sb3_sap.envs.torcs.simulator import check_start, start_place, step_ticks
from sb3_sap.envs.torcs.throttle import PERIOD, PERIOD_TICKS
from sb3_sap.envs.tracks import read_track_xml

Observation = NDArray[np.float32]
Action = NDArray[np.float32]


class RacingEnv(gym.Env[Observation, Action]):
    """Drive laps as fast as the car and the road allow.

    Observation, (30,): the sensors `sensors.NAMES` in `sensors.UNITS`. Action, (2,): steering from -1 (right) to 1
    (left) times the car's lock; pedal from -1 (full brake) to 1 (full throttle). The gears are automatic.

    Reward: metres of progress along the centre line in the step. An episode *terminates* when the car leaves the road
    (|trackPos| > 1), faces backwards (cos of the angle < 0) or does not get 10 m further within 5 s
    (`lap_clock`). No penalty comes with it: all rewards lie ahead, so what ends an episode forfeits them, while a
    penalty would make standing still safer than driving. It is *truncated* when the laps are completed, counted from
    where the car started.

    ``info`` holds the raw readings: ``sensors``, by their SCR names, with lists for track and wheelSpinVel; angle
    (rad), track_pos, speed_x, speed_y, speed_z (km/h) and distance (m) as in lane keeping; damage (points); off_track;
    time (s, of the episode); ``covered``, the fraction driven of the laps; ``lap_times`` (s), of the completed ones,
    interpolated within a step; lap_done: all are completed, which is_success repeats for SB3's success
    rate.

    :param track: name of a track that TORCS ships, or the path of a track file
    :param control_step: s between two actions, a multiple of 0.002
    :param car: name of a car that TORCS ships
    :param start: "training", 100 m before the line, or "race", the engine's own grid; the car stands
    :param laps: laps to drive, or None to drive on
    :param random_start: start anywhere on the track, near the centre line; the car stands
    :param skill_level: 0 (rookie) to 3 (pro): a rookie's tyres hold best, and only a rookie's car takes no damage
    :param render_mode: None, "rgb_array" or "human"
    :raise ValueError: for an invalid argument, a start that does not exist, or an action of NaN
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # type: ignore[misc]

    def __init__(
        self,
        track: str | os.PathLike[str] = "wheel-2",
        control_step: float = 0.1,
        car: str = "car1-trb1",
        start: str = "race",
        laps: int | None = 1,
        random_start: bool = False,
        skill_level: int = 0,
        render_mode: str | None = None,
    ) -> None:
        check_start(start)
        check_laps(laps)
        check_render_mode(render_mode)
        whole, rest = divmod(step_ticks(control_step), PERIOD_TICKS)
        self._periods = [PERIOD_TICKS] * whole + ([rest] if rest else [])
        self.control_step = control_step
        self.laps = laps
        self.random_start = random_start
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / control_step))}  # type: ignore[misc]
        self.simulation = Physics(track, car, skill_level, damage_factor=1.0)
        self.length = self.simulation.length
        self.track = read_track_xml(self.simulation.track_path)
        self.start = start_place(start, self.simulation.track_path, self.length)
        self._sensors = Sensors(self.simulation)
        limit = (LIMITS / UNITS).astype(np.float32)
        self.observation_space = gym.spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
        self._viewer: Any = None
        self._on_road = False

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Place the car, at rest, and return the first observation, (30,), and ``info``.

        ``options`` may choose the start: distance (m), track_pos and angle (rad); the others keep their defaults.
        """
        super().reset(seed=seed)
        start = dict(self.start)
        if self.random_start:
            start["distance"] = self.np_random.uniform(0.0, self.length)
            start["track_pos"] = self.np_random.uniform(-RANDOM_TRACK_POS, RANDOM_TRACK_POS)
            start["angle"] = self.np_random.uniform(-RANDOM_ANGLE, RANDOM_ANGLE)
        start.update(checked_start(options or {}, self.length))
        self.simulation.place(**start)
        self._gearbox = Gearbox(self.simulation, PERIOD)
        self._reading = self._sensors.read()
        self._on_road = True
        self._steering = 0.0
        self._clock = LapClock(self._reading.distance, self.length, self.control_step)
        if self.render_mode == "human":
            self.render()
        return observation(self._reading.sensors), self._info()

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive one control step and return observation (30,), reward, terminated, truncated and ``info``."""
        steering, pedal = self._checked(action)
        self._steering = steering
        self._drive(steering, pedal)
        self._reading = reading = self._sensors.read()
        metres = self._clock.count(reading.distance)
        info = self._info()
        lost = info["off_track"] or not math.cos(reading.sensors[0]) >= 0 or self._clock.stalled
        finished = self.laps is not None and info["lap_done"]
        if self.render_mode == "human":
            self.render()
        return observation(reading.sensors), metres, lost, finished, info

    def _checked(self, action: Action) -> tuple[float, float]:
        try:
            steering, pedal = np.asarray(action, dtype=np.float64).reshape(2).tolist()
        except (TypeError, ValueError) as error:
            raise ValueError(f"action must be of {self.action_space}, got {action!r}.") from error
        if steering != steering or pedal != pedal:
            raise ValueError(f"action must be numbers in [-1, 1], got {[steering, pedal]}.")
        if not self._on_road:
            raise RuntimeError("step() was called before reset(): the car is not on the road yet.")
        return min(max(steering, -1.0), 1.0), min(max(pedal, -1.0), 1.0)

    def _drive(self, steering: float, pedal: float) -> None:
        simulation, gearbox = self.simulation, self._gearbox
        car, advance = simulation.car, simulation.advance
        throttle = max(pedal, 0.0)
        simulation.control(steering, throttle, max(-pedal, 0.0), gear=gearbox.gear(car.engine_speed))
        advance(self._periods[0])
        for ticks in self._periods[1:]:
            # Shifting cuts the throttle command; the others hold.
            car.accelerator, car.gear_command = throttle, gearbox.gear(car.engine_speed)
            advance(ticks)

    def _info(self) -> dict[str, Any]:
        (raw, distance, damage), clock = self._reading, self._clock
        angle, track, spins = raw[0], raw[TRACK], raw[SPINS]
        track_pos, speed_x, speed_y, speed_z = raw[MOTION]
        off_track = not abs(track_pos) <= 1
        covered = max(clock.progress / ((self.laps or 1) * self.length), 0.0)
        if self.laps is not None:
            covered = min(covered, 1.0)
        lap_done = covered >= 1 and not off_track
        return {
            "sensors": {
                "angle": angle,
                "track": track,
                "trackPos": track_pos,
                "speedX": speed_x,
                "speedY": speed_y,
                "speedZ": speed_z,
                "wheelSpinVel": spins,
                "rpm": raw[-2],
                "gear": raw[-1],
            },
            "angle": angle,
            "track_pos": track_pos,
            "speed_x": speed_x,
            "speed_y": speed_y,
            "speed_z": speed_z,
            "distance": distance,
            "damage": damage,
            "time": clock.time,
            "covered": covered,
            "off_track": off_track,
            "lap_times": clock.lap_times,
            "lap_done": lap_done,
            "is_success": lap_done,
        }

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the car on its track: an image (height, width, 3) for "rgb_array", a window for "human"."""
        if self.render_mode is None:
            gym.logger.warn("render() draws nothing: the environment was made without a render_mode.")
            return None
        if self._viewer is None:
            from sb3_sap.envs.viewer import Viewer

            self._viewer = Viewer(self.track, window=self.render_mode == "human")
        raw, distance, _ = self._reading
        track_pos, speed_x, speed_y, speed_z = raw[MOTION]
        state = CarState(raw[0], track_pos, speed_x, speed_y, speed_z, distance)
        image: NDArray[np.uint8] = self._viewer.draw(state, self._steering)
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one, and the simulation."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
        self.simulation.close()
