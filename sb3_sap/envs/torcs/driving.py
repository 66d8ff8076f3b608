"""``sap/TorcsDriving-v0``: steering and pedal at racing speed. The paper leaves several action dimensions open."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_sap.envs.car import CarState
from sb3_sap.envs.lane_keeping import OBSERVATION_LIMIT, OBSERVATION_SCALE, LaneKeepingEnv
from sb3_sap.envs.torcs.simulator import TorcsSimulator
from sb3_sap.envs.units import KMH

#: Distances ahead of the car at which the road's curvature is observed, m.
LOOK_AHEAD = (5.0, 10.0, 20.0, 35.0, 55.0, 80.0, 110.0, 150.0)
#: Unit of an observed curvature, 1/m (a curve of 50 m radius).
CURVATURE_SCALE = 0.02
#: Largest magnitude of an observed curvature, in those units.
CURVATURE_LIMIT = 5.0
#: Acceleration above what the tyres can give in any direction (about 1.5 g), m/s²: what it cannot do is impossible.
MAX_ACCELERATION = 20.0
#: Acceleration below what the tyres give on any road (about 0.3 g), m/s²: what it can do is always possible.
SURE_ACCELERATION = 3.0
#: |angle| (rad) and |trackPos| below which a car is well placed.
SURE_ANGLE, SURE_TRACK_POS = 0.2, 0.5
#: Time to the edge at the present lateral speed, below which moving faster towards it is a mistake, s.
EDGE_TIME = 1.0
#: Index of half the road's width in the observation.
HALF_WIDTH = slice(5 + len(LOOK_AHEAD), 6 + len(LOOK_AHEAD))
#: Unit of the observed half width, m.
WIDTH_SCALE = 10.0


def lateral_velocity(obs: NDArray[Any]) -> NDArray[Any]:
    """Speed across the road, (n,) m/s, positive to the left, of (n, obs_dim) observations."""
    angle, speed_x, speed_y = obs[:, 0], obs[:, 2] * OBSERVATION_SCALE[2] / KMH, obs[:, 3] * OBSERVATION_SCALE[3] / KMH
    return speed_y * np.cos(angle) - speed_x * np.sin(angle)  # type: ignore[no-any-return]


def ap_function(obs: NDArray[Any], actions: NDArray[Any], next_obs: NDArray[Any]) -> NDArray[np.bool_]:
    """Three mistakes that no fast lap contains; each is judged where the step began and confirmed by what it led to.

    1. *Running wide*: at its lateral speed the car reaches the edge within a second, and the step made that
       lateral speed larger. Leaving the road ends the episode, so the speed must be taken back, and the later
       the more it costs.
    2. *Too fast for what lies ahead*: even tyres better than the car's could not brake from here to a speed that holds
       the road at some point ahead, and the step made the car faster still.
    3. *Dawdling*: well placed on the road, the car is slower than even poor tyres would hold through everything that
       is in sight, and the step made it slower still.

    They are sound as far as their constants are: the second forbids nothing possible and the third nothing useful, as
    the tyres lie between the two accelerations; the first may in principle forbid a short cut along the edge.

    :param obs: (n, 14) as the environment returns them
    :param actions: (n, 2)
    :param next_obs: (n, 14)
    :return: (n,) True where permissible
    """
    del actions
    outward = lateral_velocity(next_obs) * np.sign(next_obs[:, 1])
    room = (1 - np.abs(next_obs[:, 1])) * next_obs[:, HALF_WIDTH][:, 0] * WIDTH_SCALE  # m to the edge
    faster_outward = outward > lateral_velocity(obs) * np.sign(next_obs[:, 1])
    runs_wide = (outward > 0) & (room < outward * EDGE_TIME) & faster_outward
    faster = next_obs[:, 2] > obs[:, 2]
    slower = next_obs[:, 2] < obs[:, 2]
    return ~(runs_wide | (too_fast(obs) & faster) | (dawdles(obs) & slower))  # type: ignore[no-any-return]


def too_fast(obs: NDArray[Any]) -> NDArray[np.bool_]:
    """Where no braking could make the car slow enough for the road ahead; (n,) bool of (n, obs_dim) observations."""
    curvature = np.abs(obs[:, 5 : 5 + len(LOOK_AHEAD)]) * CURVATURE_SCALE  # (n, points), 1/m
    speed_squared = (obs[:, 2:3] * OBSERVATION_SCALE[2] / KMH) ** 2
    holds = MAX_ACCELERATION / np.maximum(curvature, 1e-6)  # v² at which the tyres still hold the curve
    can_brake = 2 * MAX_ACCELERATION * np.array(LOOK_AHEAD)  # v² that braking takes off on the way there
    return (speed_squared > holds + can_brake).any(axis=1)  # type: ignore[no-any-return]


def dawdles(obs: NDArray[Any]) -> NDArray[np.bool_]:
    """Where a well placed car is slower than anything in sight requires; (n,) bool of (n, obs_dim) observations."""
    sharpest = np.abs(obs[:, 5 : 5 + len(LOOK_AHEAD)]).max(axis=1) * CURVATURE_SCALE  # (n,), 1/m
    speed_squared = (obs[:, 2] * OBSERVATION_SCALE[2] / KMH) ** 2
    well_placed = (np.abs(obs[:, 0]) < SURE_ANGLE) & (np.abs(obs[:, 1]) < SURE_TRACK_POS)
    # Beyond sight there may be a hairpin: from a higher speed poor tyres could not stop for it.
    in_sight = np.minimum(SURE_ACCELERATION / np.maximum(sharpest, 1e-6), 2 * SURE_ACCELERATION * LOOK_AHEAD[-1])
    return well_placed & (speed_squared < in_sight)  # type: ignore[no-any-return]


class DrivingEnv(LaneKeepingEnv):
    """Drive as fast as the road allows (TORCS only).

    Observation, (14,): the five of lane keeping; the road's curvature at `LOOK_AHEAD` metres, in units of
    `CURVATURE_SCALE`, positive to the left; half the road's width in units of `WIDTH_SCALE` m. Action, (2,): steering,
    positive to the left; pedal, from -1 (full brake) to 1 (full throttle); the gears are automatic. Reward: metres of
    progress along the centre line. Episodes end as in lane keeping.
    """

    simulator: TorcsSimulator

    def __init__(self, simulator: TorcsSimulator, **kwargs: Any):
        super().__init__(simulator, **kwargs)
        own = np.full(len(LOOK_AHEAD) + 1, CURVATURE_LIMIT)
        self._limit = np.concatenate([OBSERVATION_LIMIT / OBSERVATION_SCALE, own]).astype(np.float32)
        # Racing speeds go beyond those of lane keeping.
        self._limit[2] = 400.0 / OBSERVATION_SCALE[2]
        self.observation_space = gym.spaces.Box(-self._limit, self._limit, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def _drive(self, action: list[float]) -> CarState:
        self._steering = action[0]
        self._last_observation = self._observation()
        return self.simulator.drive(*action)

    def _reward(self, before: CarState, state: CarState) -> float:
        half = self.simulator.length / 2
        return (state.distance - before.distance + half) % (2 * half) - half

    def _permissible(self, before: CarState, state: CarState) -> bool:
        obs, next_obs = self._last_observation[None], self._observation()[None]
        return bool(ap_function(obs, np.zeros((1, 2)), next_obs)[0])

    def _observation(self) -> NDArray[np.float32]:
        track, state = self.simulator.track, self._state
        ahead = [
            track.pieces[track.piece_at((state.distance + metres) % track.length)].curvature / CURVATURE_SCALE
            for metres in LOOK_AHEAD
        ]
        half_width = track.width / 2 / WIDTH_SCALE
        raw = np.concatenate([np.array(state[:5]) / OBSERVATION_SCALE, ahead, [half_width]])
        return np.clip(raw.astype(np.float32), -self._limit, self._limit)
