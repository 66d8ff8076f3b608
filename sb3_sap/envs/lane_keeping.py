"""The paper's task: keep a car on the centre line by steering alone, at a default speed.

State, action, reward and AP function are those of sections 4.1 and 5.1. A `Simulator` moves the car; this module knows
none by name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_sap.common.errors import nearest
from sb3_sap.envs.car import CarState, Simulator
from sb3_sap.envs.units import KMH

#: Units of the observation: angle in 1 rad, trackPos in 1, speedX, speedY and speedZ in 50 km/h (order of Table 1).
OBSERVATION_SCALE = np.array([1.0, 1.0, 50.0, 50.0, 50.0])
#: Magnitudes at which the observation is clipped: rad, trackPos, km/h.
OBSERVATION_LIMIT = np.array([math.pi, 2.0, 200.0, 200.0, 200.0])
#: Reward of the step that leaves the road or turns the car backwards (from the code that the paper cites).
OFF_TRACK_REWARD = -200.0
#: Speed |V_x| below which the car stands still, km/h.
STILL_SPEED = 1.0
#: Time after which an episode ends if the car stands still, s.
STILL_TIME = 5.0
#: Time at the beginning of an episode that does not count, because a simulator may start the car from rest, s.
GRACE_TIME = 3.0
#: Largest |trackPos| of a random start.
RANDOM_TRACK_POS = 0.5
#: Largest |angle| of a random start, rad.
RANDOM_ANGLE = 0.2

Observation = NDArray[np.float32]
Action = NDArray[np.float32]


def reward(state: CarState) -> float:
    """Return the reward of reaching ``state``, in km/h; at best V_x, on the centre line and aligned with it.

    The paper leaves the absolute values of sin θ and δ open; without them one edge would pay more than the centre.
    """
    # δ is trackPos, θ the angle, V_x in km/h
    return state.speed_x * (math.cos(state.angle) - abs(math.sin(state.angle)) - abs(state.track_pos))  # Eq. (5)


def ap_function(obs: NDArray[Any], actions: NDArray[Any], next_obs: NDArray[Any]) -> NDArray[np.bool_]:
    """Label as permissible the actions that did not take the car further from the centre line (Eq. 6).

    :param obs: observations, as the environment returns them, shape (n, 5)
    :param actions: the actions executed there, shape (n, 1); Eq. (6) judges by the states alone
    :param next_obs: the observations that followed, shape (n, 5)
    :return: True where permissible, shape (n,)
    """
    del actions
    moved_away: NDArray[np.bool_] = np.abs(next_obs[:, 1]) - np.abs(obs[:, 1]) > 0  # Eq. (6)
    return ~moved_away


def score(total_reward: float, length: float, control_step: float) -> float:
    """Return the normalised score S of one lap: 1 is a perfect lap, at any speed, on any track.

    Each step earns at most V_x, and the V_x·Δt of a lap add up to its length, so its total is at most 3.6·L/Δt.

    :param total_reward: sum of the rewards of the lap
    :param length: L, m
    :param control_step: Δt, s
    """
    return total_reward / (KMH * length / control_step)


class LaneKeepingEnv(gym.Env[Observation, Action]):
    """Keep the car in its lane (Table 1, Eq. 5, Eq. 6).

    Observation: angle, trackPos, speedX, speedY, speedZ in units of `OBSERVATION_SCALE`, float32, shape (5,).
    Action: steering in [-1, 1], shape (1,), times `STEERING_LOCK`; positive turns left; what lies outside is clipped.
    Reward: Eq. (5) of the state reached.

    An episode *terminates* when the car leaves the road (|trackPos| > 1) or faces backwards (cos θ < 0), both with
    ``off_track_reward`` in place of Eq. (5), and when it stands still, with the reward unchanged. It is *truncated*
    when the laps are completed, counted from where it started.

    ``info`` holds the raw angle (rad), track_pos, speed_x, speed_y, speed_z (km/h) and distance (m); off_track;
    ``covered``, the fraction driven of the laps (of one lap, beyond 1 too, if ``laps=None``); lap_done: they are
    covered; and after a step ``permissible``, Eq. (6) on the raw values.

    ``reset(options={"distance": m, "track_pos": …, "angle": rad})`` chooses the start; the others keep their defaults.

    :param simulator: moves the car
    :param laps: laps to drive, or None to drive on as the paper trains
    :param random_start: start anywhere on the track, near the centre line, instead of centred and aligned at the start
    :param off_track_reward: reward of the step that leaves the road or turns the car backwards; the paper gives none
    :param render_mode: None, "rgb_array" or "human"
    :raise ValueError: for an invalid argument, a start that does not exist, or a steering of NaN
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # type: ignore[misc]

    def __init__(
        self,
        simulator: Simulator,
        *,
        laps: int | None = 1,
        random_start: bool = False,
        off_track_reward: float = OFF_TRACK_REWARD,
        render_mode: str | None = None,
    ) -> None:
        check_laps(laps)
        if not (isinstance(off_track_reward, (int, float, np.number)) and math.isfinite(off_track_reward)):
            raise ValueError(f"off_track_reward must be a number, got {off_track_reward!r}.")
        check_render_mode(render_mode)
        self.simulator = simulator
        self.laps = laps
        self.random_start = random_start
        self.off_track_reward = off_track_reward
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / simulator.control_step))}  # type: ignore[misc]
        limit = (OBSERVATION_LIMIT / OBSERVATION_SCALE).astype(np.float32)
        self.observation_space = gym.spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
        self._limit = limit
        self._viewer: Any = None
        self._on_road = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Place the car and return the first observation, shape (5,), and ``info`` without "permissible"."""
        super().reset(seed=seed)
        start = dict(self.simulator.start)
        if self.random_start:
            start["distance"] = self.np_random.uniform(0.0, self.simulator.length)
            start["track_pos"] = self.np_random.uniform(-RANDOM_TRACK_POS, RANDOM_TRACK_POS)
            start["angle"] = self.np_random.uniform(-RANDOM_ANGLE, RANDOM_ANGLE)
        start.update(checked_start(options or {}, self.simulator.length))
        self._state = self.simulator.reset(**start)
        self._on_road = True
        self._steering = 0.0
        self._progress = 0.0  # m
        self._steps = 0
        self._still_steps = 0
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info()

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Steer for one control step and return observation (5,), reward, terminated, truncated and ``info``."""
        try:
            controls = np.asarray(action, dtype=np.float64).reshape(self.action_space.shape).tolist()
        except (TypeError, ValueError) as error:
            raise ValueError(f"action must be of {self.action_space}, got {action!r}.") from error
        if any(map(math.isnan, controls)):
            raise ValueError(f"action must be numbers in [-1, 1], got {controls}.")
        if not self._on_road:
            raise RuntimeError("step() was called before reset(): the car is not on the road yet.")
        before, dt = self._state, self.simulator.control_step
        self._state = state = self._drive([min(max(control, -1.0), 1.0) for control in controls])
        half = self.simulator.length / 2
        self._progress += (state.distance - before.distance + half) % (2 * half) - half  # across the start line too
        self._steps += 1
        moving = abs(state.speed_x) >= STILL_SPEED or self._steps * dt <= GRACE_TIME
        self._still_steps = 0 if moving else self._still_steps + 1

        info = self._info()
        info["permissible"] = self._permissible(before, state)
        lost = info["off_track"] or math.cos(state.angle) < 0
        stands = self._still_steps >= round(STILL_TIME / dt)
        finished = self.laps is not None and info["lap_done"]
        if self.render_mode == "human":
            self.render()
        earned = self.off_track_reward if lost else self._reward(before, state)
        return self._observation(), earned, lost or stands, finished, info

    def _drive(self, action: list[float]) -> CarState:
        self._steering = action[0]
        return self.simulator.step(self._steering)

    def _reward(self, before: CarState, state: CarState) -> float:
        return reward(state)

    def _permissible(self, before: CarState, state: CarState) -> bool:
        return not abs(state.track_pos) - abs(before.track_pos) > 0  # Eq. (6)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the car on its track: an image (height, width, 3) for "rgb_array", a window for "human"."""
        if self.render_mode is None:
            gym.logger.warn("render() draws nothing: the environment was made without a render_mode.")
            return None
        if self._viewer is None:
            from sb3_sap.envs.viewer import Viewer

            self._viewer = Viewer(self.simulator.track, window=self.render_mode == "human")
        image: NDArray[np.uint8] = self._viewer.draw(self._state, self._steering)
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one, and the simulator."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
        self.simulator.close()

    def _observation(self) -> Observation:
        scaled = (np.array(self._state[:5]) / OBSERVATION_SCALE).astype(np.float32)
        clipped: Observation = np.minimum(np.maximum(scaled, -self._limit), self._limit)
        return clipped

    def _info(self) -> dict[str, Any]:
        covered = max(self._progress / ((self.laps or 1) * self.simulator.length), 0.0)
        if self.laps is not None:
            covered = min(covered, 1.0)
        off_track = abs(self._state.track_pos) > 1
        lap_done = covered >= 1 and not off_track
        return {**self._state._asdict(), "covered": covered, "off_track": off_track, "lap_done": lap_done}


def check_laps(laps: Any) -> None:
    """Refuses a number of laps that cannot be driven."""
    if laps is not None and (isinstance(laps, bool) or not isinstance(laps, (int, np.integer)) or laps < 1):
        raise ValueError(f"laps must be a positive whole number, or None to drive on, got {laps!r}.")


def check_render_mode(render_mode: Any) -> None:
    """Refuses a render mode that does not exist."""
    if render_mode not in (None, "human", "rgb_array"):
        raise ValueError(f"render_mode must be None, 'human' or 'rgb_array', got {render_mode!r}.")


def checked_start(options: Mapping[str, Any], length: float) -> dict[str, float]:
    """The start that ``options`` of `reset` choose on a road of ``length`` m.

    :raise ValueError: for a name or a place that does not exist
    """
    bounds = {"distance": (0.0, length, "m"), "track_pos": (-1.0, 1.0, ""), "angle": (-math.pi / 2, math.pi / 2, "rad")}
    start = {}
    for name, value in options.items():
        if name not in bounds:
            raise ValueError(
                f"options of reset() may hold distance, track_pos and angle, got {name!r}: {nearest(name, bounds)}"
            )
        low, high, unit = bounds[name]
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not low <= number <= high:
            raise ValueError(f"options[{name!r}] must lie in [{low:g}, {high:g}] {unit}".rstrip() + f", got {value!r}.")
        start[name] = number
    return start
