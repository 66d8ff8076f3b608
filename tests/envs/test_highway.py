"""The embedded simulator, compared with motion computed by hand and with highway-env's geometry, and whole laps."""

import math
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import sb3_sap  # noqa: F401  # registers the environment
from sb3_sap.envs import CarState, get_track, highway, score
from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.highway import HighwaySimulator, road_network
from sb3_sap.envs.tracks import Segment, Track

STEP_LENGTH = 50 / 3.6 * 0.2
"""m driven in one control step."""
WHEELBASE = 5.0
"""m, highway-env's."""


def linear_feedback(obs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Steer against the angle, the offset and (undoing side slip) with the lateral speed."""
    angle, track_pos, _, speed_y, _ = obs
    return np.array([np.clip(2.5 / STEERING_LOCK * angle - 1.6 * track_pos + speed_y, -1, 1)], dtype=np.float32)


def drive_lap(track: str) -> tuple[float, float, dict[str, object]]:
    """Return S, the largest |trackPos| and the last info of linear feedback's lap."""
    env = gym.make("sap/LaneKeeping-v0", track=track)
    obs, _ = env.reset()
    total, widest, over = 0.0, 0.0, False
    while not over:
        obs, reward, terminated, truncated, info = env.step(linear_feedback(obs))
        total += float(reward)
        widest = max(widest, abs(info["track_pos"]))
        over = terminated or truncated
    return score(total, get_track(track).length, 0.2), widest, info


def long_straight() -> Track:
    return Track("straight", 12, [Segment.straight(1000)])


def test_straight_ahead_covers_the_default_speed() -> None:
    simulator = HighwaySimulator(long_straight())
    state = simulator.reset(100, 0.5, 0)
    assert state == pytest.approx(CarState(0, 0.5, 50, 0, 0, 100))
    for count in range(1, 6):
        assert simulator.step(0.0) == pytest.approx(CarState(0, 0.5, 50, 0, 0, 100 + count * STEP_LENGTH))


def test_pointing_right_drifts_right_and_positive_steering_corrects_it() -> None:
    simulator = HighwaySimulator(long_straight())
    state = simulator.reset(100, 0.0, 0.1)
    assert state.angle == pytest.approx(0.1)
    drifted = simulator.step(0.0)
    assert drifted.track_pos == pytest.approx(-math.sin(0.1) * STEP_LENGTH / 6)  # the half width is 6 m
    assert simulator.step(0.5).angle < drifted.angle


def test_steady_circle_turns_at_the_neutral_steer_rate() -> None:
    simulator = HighwaySimulator(long_straight())
    simulator.reset(0, 0, 0)
    delta = 0.05  # rad
    for _ in range(20):
        before = simulator.step(delta / STEERING_LOCK).angle
    after = simulator.step(delta / STEERING_LOCK).angle
    # With equal axles equally far from the middle, the car turns at V·δ/L, whatever the stiffness of the tyres.
    assert (before - after) % (2 * math.pi) / 0.2 == pytest.approx(50 / 3.6 * delta / WHEELBASE, rel=0.01)


@pytest.mark.parametrize("speed", [5.0, 50.0])
def test_sub_steps_are_small_enough(monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    coarse = HighwaySimulator(long_straight(), speed)
    monkeypatch.setattr(highway, "SUB_STEP", 0.001)
    fine = HighwaySimulator(long_straight(), speed)
    for simulator in (coarse, fine):
        simulator.reset(100, 0, 0)
        for steering in (1, -1, 1, -1, 0.5):
            simulator.step(steering)
    assert coarse.vehicle.position == pytest.approx(fine.vehicle.position, abs=1e-3)


@pytest.mark.parametrize("track", ["wheel-2", "g-track-3"])
def test_lanes_follow_the_pieces_of_the_track(track: str) -> None:
    plan = get_track(track)
    lanes = road_network(plan).lanes_list()
    assert len(lanes) == len(plan.pieces)
    for lane, piece in zip(lanes, plan.pieces, strict=True):
        assert lane.length == pytest.approx(piece.length)
        for along in (0.0, piece.length):
            x, y, heading = piece.point(along, 2.0)
            assert lane.position(along, 2.0) == pytest.approx((x, y))
            assert math.cos(lane.heading_at(along) - heading) == pytest.approx(1)


def test_car_state_agrees_with_the_lane_coordinates_of_highway_env() -> None:
    simulator = HighwaySimulator("wheel-2")
    state = simulator.reset(1000, 0.1, 0)
    for _ in range(300):
        obs = np.array([state.angle, state.track_pos, 1, state.speed_y / 50, 0], dtype=np.float32)
        state = simulator.step(linear_feedback(obs).item())
        along, lateral, angle = simulator.vehicle.lane_offset
        piece = simulator.track.pieces[simulator.track.piece_at(state.distance)]
        assert state.distance == pytest.approx(piece.start + along)
        assert state.track_pos == pytest.approx(lateral / 6)
        assert state.angle == pytest.approx(-angle)
    assert state.distance == pytest.approx(1000 + 300 * STEP_LENGTH, rel=0.02)


def test_linear_feedback_laps_a_short_track() -> None:
    s, widest, info = drive_lap("g-track-3")
    assert info["lap_done"]
    assert info["covered"] == 1.0
    assert s == pytest.approx(0.916, abs=0.005)
    assert widest < 0.31


@pytest.mark.slow
@pytest.mark.parametrize(
    ("track", "expected"),
    [("wheel-2", 0.944), ("eroad", 0.910), ("spring", 0.928), ("ole-road-1", 0.954), ("random:1", 0.928)],
)
def test_linear_feedback_laps_every_track(track: str, expected: float) -> None:
    s, widest, info = drive_lap(track)
    assert info["lap_done"]
    assert s == pytest.approx(expected, abs=0.005)
    assert widest < 0.5


def test_held_full_steering_leaves_the_road() -> None:
    env = gym.make("sap/LaneKeeping-v0")
    env.reset()
    terminated, steps = False, 0
    while not terminated and steps < 50:
        _, reward, terminated, _, info = env.step(np.ones(1, dtype=np.float32))
        steps += 1
    assert (terminated, reward, info["off_track"], info["lap_done"]) == (True, -200.0, True, False)
    assert info["track_pos"] > 1  # to the left


@pytest.mark.parametrize("options", [{}, {"random_start": True, "laps": None, "track": "random:3"}])
def test_environment_passes_both_checkers(options: dict[str, object]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make("sb3_sap:sap/LaneKeeping-v0", **options)  # type: ignore[arg-type]
        gymnasium_check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 10_000


def test_same_seed_gives_the_same_bits() -> None:
    def episode(seed: int) -> NDArray[np.float32]:
        env = gym.make("sap/LaneKeeping-v0", random_start=True)
        obs = [env.reset(seed=seed)[0]]
        obs += [env.step(linear_feedback(obs[-1]))[0] for _ in range(50)]
        return np.array(obs)

    assert episode(1).tobytes() == episode(1).tobytes()
    assert episode(1).tobytes() != episode(2).tobytes()


def test_same_start_and_actions_give_the_same_states() -> None:
    simulator = HighwaySimulator("eroad")
    runs = []
    for _ in range(2):
        simulator.reset(10, 0, 0)
        runs.append([simulator.step(steering) for steering in (0.3, -0.3, 0.1)])
    assert runs[0] == runs[1]


@pytest.mark.slow
def test_environments_in_subprocesses_give_the_same_observations() -> None:
    single, workers = (
        make_vec_env(
            "sb3_sap:sap/LaneKeeping-v0",  # a worker imports the module before the colon
            n_envs=2,
            seed=1,
            env_kwargs={"random_start": True},
            vec_env_cls=vec_env_cls,
        )
        for vec_env_cls in (DummyVecEnv, SubprocVecEnv)
    )
    try:
        assert np.array_equal(single.reset(), workers.reset())
        actions = np.array([[0.1], [-0.1]], dtype=np.float32)
        assert np.array_equal(single.step(actions)[0], workers.step(actions)[0])
    finally:
        workers.close()


@pytest.mark.slow
def test_importing_the_environments_loads_no_simulator() -> None:
    code = "import sys, sb3_sap.envs; sys.exit(any(name in sys.modules for name in ('highway_env', 'pygame')))"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("speed", [0, 4.9, 145, math.nan])
def test_invalid_speed_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match=r"speed must lie in \[5, 144\] km/h, got"):
        HighwaySimulator(speed=speed)


@pytest.mark.parametrize("control_step", [0, -0.2, math.inf])
def test_invalid_control_step_is_refused(control_step: float) -> None:
    with pytest.raises(ValueError, match="control_step must be a positive number of seconds, got"):
        HighwaySimulator(control_step=control_step)


def test_unknown_track_is_refused_by_gym_make() -> None:
    with pytest.raises(ValueError, match="did you mean 'spring'"):
        gym.make("sap/LaneKeeping-v0", track="sprint")
