"""The lane-keeping task, on a simulator with given states."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sb3_sap.envs import (
    CarState,
    LaneKeepingEnv,
    Track,
    ap_function,
    constraint_ce1,
    constraint_ce2,
    get_track,
    score,
)
from sb3_sap.envs.lane_keeping import OBSERVATION_SCALE, reward


class ScriptedSimulator:
    """A lap of 100 m; each step returns the next of the given states."""

    def __init__(self, *states: CarState, control_step: float = 0.2) -> None:
        self.track: Track = get_track("wheel-2")
        self.length = 100.0
        self.control_step = control_step
        self.start = {"distance": 0.0, "track_pos": 0.0, "angle": 0.0}
        self.states = list(states)
        self.steered: list[float] = []
        self.closed = False

    def reset(self, distance: float, track_pos: float, angle: float) -> CarState:
        return CarState(angle, track_pos, 0.0, 0.0, 0.0, distance)

    def step(self, steering: float) -> CarState:
        self.steered.append(steering)
        return self.states.pop(0)

    def close(self) -> None:
        self.closed = True


def car(angle: float = 0.0, track_pos: float = 0.0, speed_x: float = 50.0, distance: float = 0.0) -> CarState:
    return CarState(angle, track_pos, speed_x, 0.0, 0.0, distance)


def drive(env: LaneKeepingEnv, steps: int = 1, action: float = 0.0) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    for _ in range(steps):
        result = env.step(np.array([action], dtype=np.float32))
    return result


def started(*states: CarState, options: dict[str, Any] | None = None, **kwargs: Any) -> LaneKeepingEnv:
    env = LaneKeepingEnv(ScriptedSimulator(*states), **kwargs)
    env.reset(options=options)
    return env


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (car(), 50.0),
        (car(track_pos=0.5), 25.0),
        (car(track_pos=-0.5), 25.0),  # the other edge
        (car(angle=math.pi / 6), 50 * (math.sqrt(3) / 2 - 0.5)),
        (car(angle=-math.pi / 6), 50 * (math.sqrt(3) / 2 - 0.5)),
        (car(speed_x=-10.0), -10.0),
    ],
)
def test_reward_is_eq_5_of_the_state_reached(state: CarState, expected: float) -> None:
    assert reward(state) == pytest.approx(expected)
    assert drive(started(state))[1] == pytest.approx(expected)


def test_observation_is_table_1_in_documented_units() -> None:
    assert OBSERVATION_SCALE.tolist() == [1, 1, 50, 50, 50]
    obs, *_ = drive(started(CarState(0.1, -0.5, 50.0, -5.0, 2.5, 3.0)))
    assert obs == pytest.approx([0.1, -0.5, 1.0, -0.1, 0.05])
    assert obs.dtype == np.float32


def test_observation_of_extreme_states_is_in_its_space() -> None:
    env = started(CarState(-math.pi, 9.0, 1e6, -1e6, 1e6, 0.0))
    obs, *_ = drive(env)
    assert env.observation_space.contains(obs)


def test_info_holds_raw_values() -> None:
    env = LaneKeepingEnv(ScriptedSimulator(CarState(0.1, -0.5, 50.0, -5.0, 2.5, 25.0)))
    _, info = env.reset()
    assert "permissible" not in info
    info = drive(env)[4]
    raw = {"angle": 0.1, "track_pos": -0.5, "speed_x": 50.0, "speed_y": -5.0, "speed_z": 2.5, "distance": 25.0}
    judged = {"covered": 0.25, "off_track": False, "lap_done": False, "permissible": False}
    assert info == raw | judged


@pytest.mark.parametrize(
    ("before", "after", "permissible"),
    [(0.2, 0.1, True), (0.2, 0.3, False), (0.2, -0.1, True), (0.2, -0.3, False), (0.2, 0.2, True), (0.0, 0.0, True)],
)
def test_permissible_is_eq_6(before: float, after: float, permissible: bool) -> None:
    env = started(car(track_pos=before), car(track_pos=after))
    obs, *_ = drive(env)
    next_obs, *_, info = drive(env)
    assert info["permissible"] is permissible
    assert ap_function(obs[None], np.zeros((1, 1)), next_obs[None]).tolist() == [permissible]


def test_ap_function_takes_a_batch() -> None:
    obs, next_obs = np.zeros((3, 5)), np.zeros((3, 5))
    obs[:, 1], next_obs[:, 1] = [0.5, 0.5, 0.0], [0.4, 0.6, 0.0]
    next_obs[:, 0] = 1.0  # the angle has no influence
    labels = ap_function(obs, np.zeros((3, 1)), next_obs)
    assert labels.tolist() == [True, False, True]
    assert labels.dtype == np.bool_


@pytest.mark.parametrize(
    ("state", "off_track"),
    [(car(track_pos=1.01), True), (car(track_pos=-1.01), True), (car(angle=1.6), False), (car(angle=-1.6), False)],
)
def test_leaving_the_road_or_facing_backwards_ends_the_episode(state: CarState, off_track: bool) -> None:
    _, reward, terminated, truncated, info = drive(started(state))
    assert (reward, terminated, truncated, info["off_track"]) == (-200.0, True, False, off_track)


def test_off_track_reward_can_be_set() -> None:
    assert drive(started(car(track_pos=1.1), off_track_reward=-7.5))[1] == -7.5
    assert drive(started(car(track_pos=0.5), off_track_reward=-7.5))[1] == 25.0
    with pytest.raises(ValueError, match="off_track_reward must be a number, got inf"):
        LaneKeepingEnv(ScriptedSimulator(), off_track_reward=math.inf)


def test_edge_itself_is_on_the_road() -> None:
    _, reward, terminated, _, info = drive(started(car(track_pos=1.0)))
    assert (reward, terminated, info["off_track"]) == (pytest.approx(0.0), False, False)


def test_standing_still_ends_the_episode_after_grace_and_five_seconds() -> None:
    env = started(*[car(speed_x=0.5)] * 40)  # 15 steps of grace (3 s), 25 of standing (5 s)
    assert not drive(env, 39)[2]
    _, reward, terminated, truncated, _ = drive(env)
    assert (reward, terminated, truncated) == (0.5, True, False)


def test_moving_again_restarts_the_five_seconds() -> None:
    env = started(*[car(speed_x=0.0)] * 39, car(speed_x=-2.0), *[car(speed_x=0.0)] * 25)
    assert not drive(env, 64)[2]
    assert drive(env)[2]


def test_lap_is_counted_from_where_it_started_and_across_the_line() -> None:
    env = started(
        car(distance=90.0), car(distance=30.0), car(distance=59.0), car(distance=61.0), options={"distance": 60}
    )
    assert drive(env)[4]["covered"] == pytest.approx(0.3)
    assert drive(env)[4]["covered"] == pytest.approx(0.7)
    _, _, terminated, truncated, info = drive(env)
    assert (terminated, truncated, info["lap_done"]) == (False, False, False)
    _, _, terminated, truncated, info = drive(env)
    assert (terminated, truncated, info["lap_done"], info["covered"]) == (False, True, True, 1.0)


def test_rolling_back_over_the_line_covers_nothing() -> None:
    _, _, _, truncated, info = drive(started(car(distance=99.0)))
    assert (truncated, info["covered"], info["lap_done"]) == (False, 0.0, False)


def test_episode_ends_after_the_given_laps_or_never() -> None:
    once_around = [car(distance=d) for d in (40.0, 80.0, 10.0)]
    info = drive(env := started(*once_around, *once_around, laps=2), 3)[4]
    assert (info["covered"], info["lap_done"]) == (pytest.approx(0.55), False)
    assert not drive(env, 2)[3]
    endless = started(*once_around, car(distance=50.0), laps=None)
    _, _, terminated, truncated, info = drive(endless, 4)
    assert (terminated, truncated, info["lap_done"]) == (False, False, True)
    assert info["covered"] == pytest.approx(1.5)


def test_actions_are_clipped_and_nan_refused() -> None:
    env = started(car(), car(), car())
    drive(env, action=3.0)
    drive(env, action=-3.0)
    drive(env, action=0.25)
    assert env.simulator.steered == [1.0, -1.0, 0.25]  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"action must be numbers in \[-1, 1\], got \[nan\]"):
        drive(env, action=math.nan)


def test_start_is_at_the_line_or_where_the_options_say() -> None:
    env = LaneKeepingEnv(ScriptedSimulator())
    _, info = env.reset()
    assert (info["distance"], info["track_pos"], info["angle"]) == (0.0, 0.0, 0.0)
    _, info = env.reset(options={"distance": 7, "angle": -0.1})
    assert (info["distance"], info["track_pos"], info["angle"]) == (7.0, 0.0, -0.1)


def test_random_starts_follow_the_seed() -> None:
    env = LaneKeepingEnv(ScriptedSimulator(), random_start=True)
    starts = [env.reset(seed=seed)[1] for seed in (1, 1, 2)]
    assert starts[0] == starts[1]
    assert starts[0] != starts[2]
    drawn = [env.reset()[1] for _ in range(200)]
    distances = [info["distance"] for info in drawn]
    assert 0 <= min(distances) < 10
    assert 90 < max(distances) < 100
    assert 0.4 < max(abs(info["track_pos"]) for info in drawn) <= 0.5
    assert 0.15 < max(abs(info["angle"]) for info in drawn) <= 0.2
    assert env.reset(options={"track_pos": 0.9})[1]["track_pos"] == 0.9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"track_po": 0}, "got 'track_po': did you mean 'track_pos'"),
        ({"distance": -1}, r"options\['distance'\] must lie in \[0, 100\] m, got -1"),
        ({"track_pos": 1.5}, r"options\['track_pos'\] must lie in \[-1, 1\], got 1.5"),
        ({"angle": math.nan}, r"options\['angle'\] must lie in \[-1.5708, 1.5708\] rad, got nan"),
        ({"distance": "far"}, "got 'far'"),
    ],
)
def test_invalid_starts_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LaneKeepingEnv(ScriptedSimulator()).reset(options=options)


@pytest.mark.parametrize("laps", [0, -1, 1.5, True])
def test_invalid_laps_are_refused(laps: Any) -> None:
    with pytest.raises(ValueError, match="laps must be a positive whole number, or None"):
        LaneKeepingEnv(ScriptedSimulator(), laps=laps)


def test_invalid_render_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="render_mode must be None, 'human' or 'rgb_array', got 'ansi'"):
        LaneKeepingEnv(ScriptedSimulator(), render_mode="ansi")


def test_closing_the_environment_closes_the_simulator() -> None:
    env = LaneKeepingEnv(simulator := ScriptedSimulator())
    env.close()
    assert simulator.closed


def test_score_of_a_perfect_lap_is_one() -> None:
    # 50 km/h is 13.89 m/s: a lap of 100 m takes 7.2 s, 36 steps of 0.2 s, each rewarded 50.
    assert score(36 * 50.0, 100.0, 0.2) == pytest.approx(1.0)


def interval(constraint: Any, before: float, now: float, last: float) -> tuple[float, float]:
    obs, previous_obs = np.zeros(5, np.float32), np.zeros(5, np.float32)
    obs[1], previous_obs[1] = now, before
    low, high = constraint(obs, previous_obs, np.array([last], np.float32))
    assert low.shape == high.shape == (1,)
    return low.item(), high.item()


@pytest.mark.parametrize(
    ("before", "now", "ce1", "ce2"),
    [
        (0.1, 0.2, (-1, 0.5), (-1, 0.5)),  # left, moving away: no further left
        (0.3, 0.2, (-1, 0.5), (-1, 1)),  # left, coming back
        (-0.1, -0.2, (0.5, 1), (0.5, 1)),  # right, moving away: no further right
        (-0.3, -0.2, (0.5, 1), (-1, 1)),
        (0.1, -0.2, (0.5, 1), (0.5, 1)),  # across the axis and further out
        (0.3, 0.0, (-1, 1), (-1, 1)),  # on the axis
    ],
)
def test_constraints_ce1_and_ce2_forbid_steering_further_from_the_axis(
    before: float, now: float, ce1: Sequence[float], ce2: Sequence[float]
) -> None:
    assert interval(constraint_ce1, before, now, 0.5) == ce1
    assert interval(constraint_ce2, before, now, 0.5) == ce2
