"""The environments on TORCS: the task, determinism, memory, and what is refused."""

import gc
import json
import math
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.torcs.probe import survives
from sb3_sap.envs.torcs.track_files import flatten

ENVIRONMENTS = ["sap/TorcsLaneKeeping-v0", "sap/TorcsDriving-v0", "sap/TorcsRacing-v0"]


def feedback(env):
    state = env.unwrapped._state
    steering = 2.5 * state.angle / STEERING_LOCK - 1.6 * state.track_pos + state.speed_y / 50
    return np.clip(np.array([steering], dtype=np.float32), -1, 1)


def drive(env, steps, seed=0):
    """The raw states of a drive with random steering."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    states = []
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(rng.uniform(-0.2, 0.2, env.action_space.shape))
        states.append([info[name] for name in ("angle", "track_pos", "speed_x", "speed_y", "speed_z", "distance")])
        if terminated or truncated:
            env.reset()
    return states


@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.filterwarnings("ignore")
def test_environments_pass_the_checkers(torcs, name):
    check_gymnasium(gym.make(name).unwrapped)
    check_sb3(gym.make(name))


def test_feedback_drives_a_lap_at_the_default_speed(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="g-track-3")
    env.reset()
    speeds, positions, done = [], [], False
    while not done:
        _, _, terminated, done, info = env.step(feedback(env))
        assert not terminated
        speeds.append(info["speed_x"])
        positions.append(abs(info["track_pos"]))
    assert info["lap_done"]
    assert max(positions) < 0.1
    # from rest, the default speed is reached within 5 s and held
    assert all(abs(speed - 50) < 1.5 for speed in speeds[25:])


def test_start_follows_track_options_and_seed(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="eroad")
    _, info = env.reset()
    assert info["distance"] == pytest.approx(3260.43 - 100, abs=0.1)
    assert info["track_pos"] == pytest.approx(0, abs=1e-3)
    _, info = env.reset(options={"distance": 500.0, "track_pos": 0.5, "angle": 0.1})
    assert info["distance"] == pytest.approx(500, abs=0.5)
    assert info["track_pos"] == pytest.approx(0.5, abs=0.05)
    assert info["angle"] == pytest.approx(0.1, abs=0.01)
    env = gym.make("sap/TorcsLaneKeeping-v0", track="wheel-2", start="race")
    _, info = env.reset()
    assert info["track_pos"] == pytest.approx(1 / 3, abs=1e-3)
    random = gym.make("sap/TorcsLaneKeeping-v0", random_start=True)
    places = {random.reset(seed=seed)[1]["distance"] for seed in (1, 2, 1)}
    assert len(places) == 2


def test_positive_steering_turns_left(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="wheel-2")
    env.reset()
    for _ in range(25):
        *_, info = env.step(np.array([0.2], dtype=np.float32))
    assert info["angle"] < 0  # the car points to the left of the road
    assert info["track_pos"] > 0


def test_pedals_accelerate_shift_and_brake(torcs):
    env = gym.make("sap/TorcsDriving-v0", track="b-speedway")
    env.reset()
    for _ in range(100):
        *_, info = env.step(np.array([0.0, 1.0]))
    fast = info["speed_x"]
    assert fast > 100  # beyond first gear
    assert env.unwrapped.simulator.simulation.gear > 1
    for _ in range(10):
        _, reward, *_, info = env.step(np.array([0.0, -1.0]))
    assert info["speed_x"] < fast - 30
    assert reward == pytest.approx(info["speed_x"] / 3.6 * 0.1, rel=0.15)  # metres of a step


def test_rendered_picture_is_not_uniform(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="g-track-3", render_mode="rgb_array")
    env.reset()
    assert env.render().std() > 10


def test_same_seed_and_actions_give_the_same_bits(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="eroad", random_start=True)
    first = drive(env, 60)
    assert drive(env, 60) == first  # after a reset
    other = gym.make("sap/TorcsLaneKeeping-v0", track="spring", random_start=True)
    drive(other, 30)  # another track in the same process
    assert drive(env, 60) == first
    other.close()
    env.close()
    env = gym.make("sap/TorcsLaneKeeping-v0", track="eroad", random_start=True)  # with libraries that were used before
    assert drive(env, 60) == first
    child = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n" + ANOTHER_PROCESS],
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(child.stdout.splitlines()[-1]) == first


ANOTHER_PROCESS = """
import json, gymnasium as gym, sb3_sap
from test_torcs_env import drive
print(json.dumps(drive(gym.make("sap/TorcsLaneKeeping-v0", track="eroad", random_start=True), 60)))
"""


def test_environments_side_by_side_drive_as_alone(torcs):
    alone = [drive(gym.make("sap/TorcsLaneKeeping-v0", track=name), 40) for name in ("eroad", "wheel-2")]
    pair = [gym.make("sap/TorcsLaneKeeping-v0", track=name) for name in ("eroad", "wheel-2")]
    generators = [np.random.default_rng(0) for _ in pair]
    for env in pair:
        env.reset(seed=0)
    for step in range(20):  # in turn
        for env, rng, expected in zip(pair, generators, alone, strict=True):
            *_, info = env.step(rng.uniform(-0.2, 0.2, 1))
            assert info["distance"] == expected[step][5]


def test_loaded_simulator_works_after_a_fork(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0")
    env.reset()
    assert survives(lambda: drive(env, 20)) is None
    drive(env, 20)


@pytest.mark.slow
def test_environments_in_subprocesses_drive_alike(torcs):
    envs = SubprocVecEnv([lambda: gym.make("sb3_sap:sap/TorcsLaneKeeping-v0")] * 2)
    envs.seed(0)
    envs.reset()
    for _ in range(5):
        obs, *_ = envs.step(np.zeros((2, 1)))
    assert np.array_equal(obs[0], obs[1])
    envs.close()


@pytest.mark.slow
def test_resets_use_no_further_memory(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="g-track-3").unwrapped

    def resident():
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4  # KiB

    for _ in range(500):
        env.reset()
    before = resident()
    for _ in range(20_000):
        env.reset()
    assert resident() - before < 2_000


@pytest.mark.slow
def test_library_copies_are_used_again(torcs):
    def copies():
        gc.collect()
        return sum("simuv2" in line and "r-x" in line for line in Path("/proc/self/maps").read_text().splitlines())

    gym.make("sap/TorcsLaneKeeping-v0", track="g-track-3").close()
    before = copies()
    for closed in [True, False] * 5:
        env = gym.make("sap/TorcsLaneKeeping-v0", track="g-track-3")
        env.reset()
        if closed:
            env.close()
        del env
        gc.collect()
    assert copies() == before > 0


def test_invalid_names_and_values_are_refused(torcs):
    cases = {
        "did you mean 'wheel-2'": {"track": "wheel2"},
        "did you mean 'car1-trb3' or 'car1-trb1'": {"car": "car1-trb"},
        "start must be one of 'training', 'race'": {"start": "grid"},
        "multiple of 0.002 s, got 0.001": {"control_step": 0.001},
        "multiple of 0.002 s, got nan": {"control_step": math.nan},
        "speed must lie above 0": {"speed": 0},
    }
    for message, arguments in cases.items():
        with pytest.raises(ValueError, match=message):
            gym.make("sap/TorcsLaneKeeping-v0", **arguments)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_invalid_actions_and_calls_are_refused(torcs, name):
    env = gym.make(name).unwrapped
    with pytest.raises(RuntimeError, match="before reset"):
        env.step(env.action_space.sample())
    env.reset()
    with pytest.raises(ValueError, match="numbers in"):
        env.step(np.full(env.action_space.shape, np.nan))
    for huge in (np.inf, -1e30):
        obs, *_ = env.step(np.full(env.action_space.shape, huge))
        assert np.isfinite(obs).all()
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.step(env.action_space.sample())
    with pytest.raises(RuntimeError, match="closed"):
        env.reset()


def test_track_file_of_the_user_is_driven_and_refused_once_damaged(torcs, tmp_path):
    own = tmp_path / "own.xml"
    own.write_bytes(flatten(torcs.track("g-track-3")))
    env = gym.make("sap/TorcsLaneKeeping-v0", track=str(own))
    env.reset()
    *_, info = env.step(feedback(env))
    assert info["speed_x"] > 0
    own.write_bytes(own.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"own.xml is not a readable TORCS track file"):
        gym.make("sap/TorcsLaneKeeping-v0", track=str(own))
