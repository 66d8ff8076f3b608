"""sap/TorcsRacing-v0: sensors, reward and ends, and that a scripted driver laps every track by the observation."""

import cmath
import ctypes
import math

import gymnasium as gym
import numpy as np
import pytest

from sb3_sap.envs import TRACKS, make_torcs_racing
from sb3_sap.envs.torcs.gearbox import SHIFT_TIME, Gearbox
from sb3_sap.envs.torcs.lap_clock import PROGRESS, PROGRESS_TIME, LapClock
from sb3_sap.envs.torcs.physics import TICK, Physics
from sb3_sap.envs.torcs.range_finders import DIRECTIONS, OFF_ROAD, RANGE, RangeFinders
from sb3_sap.envs.torcs.scripted import ScriptedDriver
from sb3_sap.envs.torcs.sensors import INDEX, LIMITS, NAMES, TRACK, UNITS
from sb3_sap.envs.torcs.tick_loop import _machine_code, tick_loop


def make(**options):
    return gym.make("sap/TorcsRacing-v0", **options)


def lap(env, driver):
    """The rewards of an episode, and its last info."""
    obs, info = env.reset(seed=0)
    rewards, over = [], False
    while not over:
        obs, reward, terminated, truncated, info = env.step(driver.predict(obs)[0])
        rewards.append(reward)
        over = terminated or truncated
    return rewards, info


# ------------------------------------------------------------------ sensors


def finders(track):
    simulation = Physics(track)
    return simulation, RangeFinders(simulation.road, simulation.shared)


def measured(simulation, range_finders):
    return np.array(range_finders.measure(*simulation.pose, simulation.angle, simulation.distance))


def nearest(edges, x, y, yaw):
    """The nearest crossing of each ray with any chord of the edges: what the range finders find without a search."""
    found = []
    for direction in DIRECTIONS:
        crossings = [RANGE]
        for edge in edges:
            turned = (np.array(edge) - complex(x, y)) * cmath.rect(1, -yaw - direction)
            a, b = turned[:-1], turned[1:]
            cut = (a.imag > 0) != (b.imag > 0)
            at = (a.real * b.imag - b.real * a.imag)[cut] / (b.imag - a.imag)[cut]
            crossings += at[at > 0].tolist()
        found.append(min(crossings))
    return np.array(found)


def test_range_finders_on_a_straight_are_those_of_trigonometry(torcs):
    simulation, range_finders = finders("eroad")
    simulation.place(100.0, 0.25)  # 6 m from the left edge and 10 m from the right one
    readings = measured(simulation, range_finders)
    for direction, reading in zip(DIRECTIONS, readings, strict=True):
        room = 6.0 if direction > 0 else 10.0
        expected = room / abs(math.sin(direction)) if abs(direction) > 0.2 else reading
        assert reading == pytest.approx(expected, abs=0.05)
    assert readings[0] == pytest.approx(6.0, abs=0.02)
    assert readings[18] == pytest.approx(10.0, abs=0.02)


@pytest.mark.parametrize("track", ["wheel-2", "g-track-3"])
def test_range_finders_find_the_nearest_edge_of_their_part_of_the_road(torcs, track):
    simulation, range_finders = finders(track)
    rng = np.random.default_rng(0)
    n = len(range_finders._stations)
    for _ in range(60):
        simulation.place(rng.uniform(0, simulation.length), rng.uniform(-0.7, 0.7), rng.uniform(-1.5, 1.5))
        station = np.searchsorted(range_finders._stations, simulation.distance)
        here = slice(n + station - 60, n + station + 60)
        expected = nearest([range_finders._left[here], range_finders._right[here]], *simulation.pose)
        readings = measured(simulation, range_finders)
        seen = expected < 40  # the slice is that long at least
        assert readings[seen] == pytest.approx(expected[seen], abs=1e-6)
        assert (readings[~seen] > 40 - 1e-6).all()


def test_range_finders_look_through_the_road_that_crosses_theirs(torcs):
    simulation, range_finders = finders("wheel-2")
    through, lap = [], slice(len(range_finders._stations))
    for distance in np.arange(0.0, simulation.length, 60.0):
        simulation.place(distance)
        everything = nearest([range_finders._left[lap], range_finders._right[lap]], *simulation.pose)
        through.append((measured(simulation, range_finders) - everything).max())
    assert max(through) > 20  # m: under the bridge an edge of the other road is nearer


def test_entries_of_the_observation_are_the_raw_sensors_in_their_units(torcs):
    env = make(track="eroad")
    obs, info = env.reset(seed=0)
    for _ in range(30):
        obs, _, _, _, info = env.step(np.array([0.02, 0.8]))
    raw = info["sensors"]
    speeds = raw["speedX"], raw["speedY"], raw["speedZ"]
    named = [raw["angle"], *raw["track"], raw["trackPos"], *speeds, *raw["wheelSpinVel"], raw["rpm"], raw["gear"]]
    assert len(NAMES) == len(UNITS) == len(LIMITS) == 30
    assert obs == pytest.approx(np.array(named) / UNITS, abs=1e-6)
    simulation = env.unwrapped.simulation
    assert raw["speedX"] == pytest.approx(simulation.velocity[0] * 3.6)
    assert raw["rpm"] == pytest.approx(simulation.engine_speed * 60 / math.tau)
    assert raw["wheelSpinVel"] == pytest.approx(list(simulation.wheel_spins))
    assert (raw["gear"], raw["angle"]) == (simulation.gear, simulation.angle)
    assert (raw["trackPos"], info["distance"]) == (simulation.track_pos, simulation.distance)
    assert raw["speedX"] > 30
    assert NAMES[INDEX["trackPos"]] == "trackPos"
    assert NAMES[TRACK] == tuple(f"track[{i}]" for i in range(19))


def test_range_finders_of_a_car_off_the_road_read_less_than_nothing(torcs):
    env = make(track="eroad")
    env.reset(options={"distance": 200.0, "track_pos": 0.9, "angle": -0.5})
    over = False
    while not over:
        obs, reward, over, _, info = env.step(np.array([0.0, 1.0]))
    assert info["off_track"]
    assert info["sensors"]["track"] == [OFF_ROAD] * 19
    assert env.observation_space.contains(obs)
    assert reward > 0  # no penalty: it went forward


# ------------------------------------------------------------------ the task


def test_rewards_of_a_lap_add_up_to_its_length(torcs):
    env = make(track="g-track-3")
    rewards, info = lap(env, ScriptedDriver())
    assert info["lap_done"]
    assert len(info["lap_times"]) == 1
    length = env.unwrapped.length
    assert length <= sum(rewards) < length + 10
    # within its last step, interpolated
    assert info["time"] - 0.1 < info["lap_times"][0] <= info["time"]


@pytest.mark.slow
@pytest.mark.parametrize("track", TRACKS)
def test_scripted_driver_laps_every_track_from_a_standing_start(torcs, track):
    env = make(track=track)
    _, info = lap(env, ScriptedDriver())
    assert info["lap_done"]
    assert info["damage"] == 0
    speed = env.unwrapped.length / info["lap_times"][0] * 3.6
    assert speed > 110  # km/h; the default speed of lane keeping is 50


def test_standing_still_ends_the_episode_without_a_reward(torcs):
    env = make(track="g-track-3")
    env.reset(seed=0)
    steps, total, over = 0, 0.0, False
    while not over:
        _, reward, over, truncated, _ = env.step(np.array([0.0, 0.0]))
        steps, total = steps + 1, total + reward
    assert steps == PROGRESS_TIME / 0.1
    assert not truncated
    assert abs(total) < 0.1


def test_turning_round_ends_the_episode(torcs):
    env = make(track="eroad")
    env.reset(options={"distance": 200.0, "track_pos": -0.9, "angle": -1.5})
    for _ in range(40):
        _, _, over, _, info = env.step(np.array([1.0, 0.4]))
        if over:
            break
    assert over
    assert math.cos(info["angle"]) < 0
    assert not info["off_track"]


def test_a_wall_damages_every_car_but_a_rookies(torcs):
    damage = []
    for level in (3, 0):
        env = make_torcs_racing(track="eroad", skill_level=level)
        env.reset(options={"distance": 500.0})
        for _ in range(120):  # past the end of the episode, into the barrier
            info = env.step(np.array([0.05, 1.0]))[-1]
        damage.append(info["damage"])
        env.close()
    assert damage[0] > 0
    assert damage[1] == 0


def test_laps_are_counted_one_by_one(torcs):
    env = make(track="g-track-3", laps=2, control_step=0.2)
    _, info = lap(env, ScriptedDriver(8.0))
    standing, flying = info["lap_times"]
    assert flying < standing
    assert info["covered"] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": "pit"}, "start must be one of"),
        ({"laps": 0}, "laps must be a positive whole number"),
        ({"control_step": 0.003}, "multiple of 0.002"),
        ({"car": "car1-trb9"}, "car must be one that TORCS ships"),
        ({"skill_level": 4}, "skill_level must be from 0"),
        ({"render_mode": "ansi"}, "render_mode must be"),
    ],
)
def test_bad_options_are_refused(torcs, options, message):
    with pytest.raises(ValueError, match=message):
        make_torcs_racing(**options)


def test_bad_actions_and_observations_are_refused(torcs):
    env = make(disable_env_checker=True).unwrapped
    with pytest.raises(RuntimeError, match="before reset"):
        env.step(np.zeros(2))
    env.reset()
    with pytest.raises(ValueError, match="must be of Box"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"numbers in \[-1, 1\]"):
        env.step(np.array([np.nan, 0]))
    with pytest.raises(ValueError, match="sap/TorcsRacing-v0"):
        ScriptedDriver().predict(np.zeros(14))
    with pytest.raises(ValueError, match="positive number"):
        ScriptedDriver(0)


def test_scripted_driver_predicts_batches_as_single_observations(torcs):
    env = make(track="g-track-3")
    obs, _ = env.reset(seed=0)
    driver, rows = ScriptedDriver(), []
    for _ in range(5):
        rows.append(obs)
        obs, *_ = env.step(driver.predict(obs)[0])
    single = [driver.predict(row)[0] for row in rows]
    assert driver.predict(np.array(rows))[0].tolist() == np.array(single).tolist()


def test_same_seed_and_actions_give_the_same_bits(torcs):
    runs = []
    for _ in range(2):
        env = make(track="eroad", random_start=True)
        rng = np.random.default_rng(0)
        rows = [env.reset(seed=3)[0]]
        for _ in range(60):
            obs, reward, terminated, *_ = env.step(rng.uniform([-0.2, 0.0], [0.2, 1.0]))
            rows.append(np.append(obs, reward))
            if terminated:
                rows.append(env.reset()[0])
        runs.append(np.concatenate(rows))
        env.close()
    assert runs[0].tobytes() == runs[1].tobytes()


def test_car_can_be_drawn(torcs):
    env = make(track="eroad", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (400, 600, 3)
    env.close()


# ------------------------------------------------------------------ parts


def test_native_ticks_are_those_of_python_to_the_bit(torcs):
    poses = []
    for native in (True, False):
        simulation = Physics("wheel-2")
        situation = ctypes.addressof(simulation._situation)
        simulation._run = tick_loop(simulation._library.update, situation, TICK, native=native)
        simulation.place(100.0)
        for i in range(50):
            simulation.control(0.3 * math.sin(i), 0.7, gear=1)
            simulation.advance(10 + i % 3)
        poses.append((*simulation.pose, *simulation.velocity, *simulation.wheel_spins))
        simulation.close()
    assert poses[0] == poses[1]


def test_python_loops_where_machine_code_is_forbidden(torcs, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError

    monkeypatch.setattr("mmap.mmap", refuse)
    _machine_code.cache_clear()
    try:
        simulation = Physics("wheel-2")
        assert simulation._run.__name__ == "python_loop"
        simulation.place(100.0)
        simulation.close()
    finally:
        monkeypatch.undo()
        _machine_code.cache_clear()


class Car:
    """A car with three gears, each of which halves the engine's speed."""

    red_line, top_gear = 1000.0, 3

    def gear_step(self, gear):
        return 2.0


def test_gearbox_shifts_near_the_red_line_and_not_twice_at_once():
    gearbox = Gearbox(Car(), 0.1)
    assert gearbox.gear(940) == 1
    assert gearbox.gear(960) == 2  # above 95 % of the red line
    # three decisions later at the earliest
    assert [gearbox.gear(960) for _ in range(round(SHIFT_TIME / 0.1))] == [2, 2, 3]
    assert [gearbox.gear(960) for _ in range(9)] == [3] * 9  # the highest
    # 370 rad/s would be 740 one gear lower, below 75 %; 380 would be 760
    assert gearbox.gear(380) == 3
    assert gearbox.gear(370) == 2


def test_lap_clock_counts_across_the_line_and_interpolates():
    clock = LapClock(90.0, 100.0, 1.0)
    assert clock.count(95.0) == 5
    assert clock.count(5.0) == pytest.approx(10)  # across the line
    assert clock.count(3.0) == -2
    for distance in (43.0, 83.0):
        clock.count(distance)
    assert (clock.progress, clock.lap_times) == (93, ())
    clock.count(4.0)  # 114 m after 6 s: the 100th was passed 7 m after the last count, of 21
    assert clock.lap_times == (pytest.approx(5 + 7 / 21),)
    assert clock.count(math.nan) == 0


def test_lap_clock_stalls_without_enough_progress():
    clock = LapClock(0.0, 1000.0, 1.0)
    for second in range(1, 5):
        clock.count(second * 1.0)
        assert not clock.stalled
    clock.count(5.0)
    assert clock.stalled
    clock.count(PROGRESS)
    assert not clock.stalled
