"""TORCS in process. Without TORCS these are skipped; with SB3_SAP_REQUIRE_TORCS set, as in CI, they must run."""

import contextlib
import gc
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_sap.cli.main import main
from sb3_sap.envs import TRACKS, get_track
from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.torcs import installation
from sb3_sap.envs.torcs.installation import DATA, MODULES, Installation, TorcsNotFoundError, find_installation
from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.torcs.probe import survives
from sb3_sap.envs.torcs.replay import replay
from sb3_sap.envs.torcs.simulator import TorcsSimulator, race_grid
from sb3_sap.envs.torcs.track_files import flatten

TRACES = Path(__file__).parent / "data" / "torcs"
START = TRACES / "start_conditions.json"
ENVIRONMENTS = ["sap/TorcsLaneKeeping-v0", "sap/TorcsDriving-v0"]


@pytest.fixture(scope="module")
def torcs():
    try:
        return find_installation()
    except TorcsNotFoundError as error:
        if os.environ.get("SB3_SAP_REQUIRE_TORCS"):
            raise
        pytest.skip(str(error))


@pytest.fixture
def copy_of_torcs(torcs, tmp_path):
    """A copy that may be damaged."""
    root = tmp_path / "torcs"
    for path in installation.checksums():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(torcs.root / path, root / path)
    return Installation(root)


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


# ---------------------------------------------------------------- fidelity


@pytest.mark.parametrize("name", ["wheel-2", "eroad"])
def test_replays_are_identical_to_the_bit(torcs, name):
    found = replay(TRACES / f"{name}.csv.gz", START)
    assert found.identical_rows == found.all_columns_identical_rows == found.rows >= 3000
    assert found.first_difference is None
    assert set(found.largest_deviation.values()) == {0.0}


def test_replay_takes_commands_from_columns_too(torcs, tmp_path):
    table = pd.read_csv(TRACES / "eroad.csv.gz", dtype=str).assign(commanded=1)
    table.to_csv(tmp_path / "eroad.csv.gz", index=False)
    conditions = json.loads(START.read_text())
    conditions["traces"]["eroad"]["commands"] = {"gear": "column commanded"}
    (tmp_path / "start.json").write_text(json.dumps(conditions))
    assert replay(tmp_path / "eroad.csv.gz", tmp_path / "start.json").identical
    table.assign(commanded=2).to_csv(tmp_path / "eroad.csv.gz", index=False)
    assert not replay(tmp_path / "eroad.csv.gz", tmp_path / "start.json").identical


def test_replay_notices_a_change(torcs, tmp_path):
    conditions = json.loads(START.read_text())
    conditions["common"]["skill_level"] = 3
    (tmp_path / "start.json").write_text(json.dumps(conditions))
    found = replay(TRACES / "eroad.csv.gz", tmp_path / "start.json")
    assert not found.identical
    assert found.first_difference is not None
    assert found.largest_deviation["x_m"] > 0.01


def test_replay_command(torcs, tmp_path, capsys):
    out = tmp_path / "out.json"
    trace = str(TRACES / "eroad.csv.gz")
    assert main(["torcs", "replay", trace, "--start", str(START), "--json", str(out)]) == 0
    assert json.loads(out.read_text())["eroad"]["identical_rows"] == 4000
    assert main(["torcs", "replay", trace, "--start", str(tmp_path / "none.json")]) == 1
    assert "There are no start conditions" in capsys.readouterr().err
    assert main(["torcs", "replay", str(START), "--start", str(START)]) == 1


def test_start_of_the_race_engine(torcs):
    for name, conditions in json.loads(START.read_text())["traces"].items():
        grid = race_grid(torcs.track(name), conditions["track_length_m"])
        assert grid["distance"] == pytest.approx(conditions["grid"]["start_pos_m"])
        assert grid["track_pos"] == pytest.approx(conditions["grid"]["trackPos"])
        simulation = Physics(name)
        simulation.place(**grid)
        settled = conditions["settled"]
        assert simulation.pose == pytest.approx((settled["x_m"], settled["y_m"], settled["yaw_rad"]), abs=1e-4)
        simulation.close()


@pytest.mark.parametrize("name", list(TRACKS))
def test_shipped_plans_are_those_of_torcs(torcs, name):
    simulation = Physics(name)
    assert simulation.length == pytest.approx(get_track(name).length, abs=0.06)
    assert simulation.road.segments[0].width == get_track(name).width
    simulation.close()


# ---------------------------------------------------------------- the task


@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.filterwarnings("ignore")
def test_environments_pass_the_checkers(torcs, name):
    check_gymnasium(gym.make(name).unwrapped)
    check_sb3(gym.make(name))


def test_a_lap_at_the_default_speed(torcs):
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


def test_starts(torcs):
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


def test_pedals(torcs):
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


def test_pictures(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="g-track-3", render_mode="rgb_array")
    env.reset()
    assert env.render().std() > 10


# ---------------------------------------------------------------- determinism and isolation


def test_same_seed_and_actions_same_bits(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="eroad", random_start=True)
    first = drive(env, 60)
    assert drive(env, 60) == first  # after a reset
    other = gym.make("sap/TorcsLaneKeeping-v0", track="spring", random_start=True)
    drive(other, 30)  # another track in the same process
    assert drive(env, 60) == first
    other.close()
    env.close()
    env = gym.make("sap/TorcsLaneKeeping-v0", track="eroad", random_start=True)  # libraries that were used before
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
from test_torcs import drive
print(json.dumps(drive(gym.make("sap/TorcsLaneKeeping-v0", track="eroad", random_start=True), 60)))
"""


def test_two_environments_side_by_side(torcs):
    alone = [drive(gym.make("sap/TorcsLaneKeeping-v0", track=name), 40) for name in ("eroad", "wheel-2")]
    pair = [gym.make("sap/TorcsLaneKeeping-v0", track=name) for name in ("eroad", "wheel-2")]
    generators = [np.random.default_rng(0) for _ in pair]
    for env in pair:
        env.reset(seed=0)
    for step in range(20):  # in turn
        for env, rng, expected in zip(pair, generators, alone, strict=True):
            *_, info = env.step(rng.uniform(-0.2, 0.2, 1))
            assert info["distance"] == expected[step][5]


def test_fork_after_load(torcs):
    env = gym.make("sap/TorcsLaneKeeping-v0")
    env.reset()
    assert survives(lambda: drive(env, 20)) is None
    drive(env, 20)


@pytest.mark.slow
def test_worker_processes(torcs):
    envs = SubprocVecEnv([lambda: gym.make("sb3_sap:sap/TorcsLaneKeeping-v0")] * 2)
    envs.seed(0)
    envs.reset()
    for _ in range(5):
        obs, *_ = envs.step(np.zeros((2, 1)))
    assert np.array_equal(obs[0], obs[1])
    envs.close()


@pytest.mark.slow
def test_memory_stays_flat(torcs):
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


def test_libraries_are_used_again(torcs):
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


@pytest.mark.slow
def test_closing_gives_everything_back(torcs):
    def resident_after(times):
        for _ in range(times):
            simulation = Physics("g-track-3")
            simulation.place(0.0)
            simulation.close()
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4  # KiB

    before = resident_after(20)
    growth = []
    for _ in range(3):  # the allocator takes a page now and then: a leak grows every time
        after = resident_after(60)
        growth.append(after - before)
        before = after
    assert min(growth) < 1_000  # each car's parameters are 0.1 MB


# ---------------------------------------------------------------- what users do wrong


def test_wrong_names_and_values(torcs):
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
def test_actions_that_are_no_numbers(torcs, name):
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


def test_simulation_checks_what_it_is_given(torcs):
    simulation = Physics("g-track-3")
    with pytest.raises(RuntimeError, match="place"):
        simulation.advance(1)
    with pytest.raises(RuntimeError, match="place"):
        _ = simulation.distance
    with pytest.raises(ValueError, match="finite"):
        simulation.place(math.nan)
    simulation.place(0.0)
    for controls in ((math.nan, 0.0), (0.0, 2.0), (0.0, 0.0, 0.0, 0.0, 99)):
        with pytest.raises(ValueError, match="Controls must lie"):
            simulation.control(*controls)
    with pytest.raises(ValueError, match="skill_level"):
        Physics("g-track-3", skill_level=7)


@pytest.mark.parametrize("reading", ["angle", "heading", "track_pos", "distance"])
def test_no_reading_without_a_road(torcs, reading):
    """TORCS itself would read from address 0, or from a track that was given back."""
    simulation = Physics("g-track-3")
    with pytest.raises(RuntimeError, match="place"):
        getattr(simulation, reading)
    simulation.place(0.0)
    assert math.isfinite(getattr(simulation, reading))
    simulation.close()
    with pytest.raises(RuntimeError, match="closed"):
        getattr(simulation, reading)


def test_places_off_the_road_and_factors_out_of_range(torcs):
    simulation = Physics("g-track-3")
    for place in ((0.0, 1.5), (0.0, -1e9), (0.0, 0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 1e30)):
        with pytest.raises(ValueError, match="placed on the road"):
            simulation.place(*place)
    for factors in ({"fuel_factor": math.nan}, {"damage_factor": -1.0}, {"damage_factor": 1e30}):
        with pytest.raises(ValueError, match="_factor must lie in"):
            Physics("g-track-3", **factors)


@pytest.mark.skipif(shutil.which("localedef") is None, reason="localedef is not there to make a locale")
def test_a_locale_with_a_decimal_comma(torcs, tmp_path):
    """TORCS reads numbers with strtod, to which "0.5" is then 0: Wheel-2 would be 53 m shorter."""
    made = subprocess.run(
        ["localedef", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "de_DE.UTF-8")], capture_output=True, check=False
    )
    if not (tmp_path / "de_DE.UTF-8" / "LC_NUMERIC").is_file():
        pytest.skip(f"localedef makes no de_DE here: {made.stderr.decode().strip()[:100]}")
    code = (
        "import locale; locale.setlocale(locale.LC_ALL, 'de_DE.UTF-8')\n"
        "from sb3_sap.envs.torcs.physics import Physics\n"
        "print(Physics('wheel-2').length, locale.localeconv()['decimal_point'])"
    )
    environment = {**os.environ, "LOCPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["6205.462890625", ","]


def test_every_car_shifts(torcs):
    """The engines' red lines lie between 576 and 1,958 rad/s: gears go by the car's own."""
    simulation = Physics("g-track-3", "car1-ow1")
    simulation.place(0.0)
    assert simulation.top_gear == 7
    simulation.control(0.0, 1.0, gear=7)
    for car in ("car1-trb1", "p406", "buggy"):
        simulator = TorcsSimulator("a-speedway", speed=90.0, car=car)
        simulator.reset(50.0, 0.0, 0.0)
        gears = set()
        for _ in range(25):
            simulator.step(0.0)
            gears.add(simulator.simulation.gear)
        assert max(gears) > 1, car
        simulator.close()


def test_nothing_installed(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("TORCS_ROOT", str(tmp_path))
    with pytest.raises(TorcsNotFoundError, match=r"no TORCS in TORCS_ROOT=.*sb3-sap torcs install"):
        find_installation()
    assert main(["torcs", "check"]) == 1
    assert "sb3-sap torcs install" in capsys.readouterr().err


def test_another_machine(monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(TorcsNotFoundError, match="on Linux on x86_64 alone, but this is linux on aarch64"):
        find_installation()


def test_another_version_and_missing_parts(copy_of_torcs, monkeypatch):
    monkeypatch.setenv("TORCS_ROOT", str(copy_of_torcs.root))
    assert find_installation() == copy_of_torcs
    library = copy_of_torcs.root / MODULES["simu"]
    whole = library.read_bytes()
    library.write_bytes(whole + b"\0")
    with pytest.raises(TorcsNotFoundError, match=r"simuv2.so is not that of Debian's torcs 1.3.7"):
        find_installation()
    library.write_bytes(whole)
    (copy_of_torcs.root / MODULES["track"]).unlink()
    with pytest.raises(TorcsNotFoundError, match=r"track.so is missing"):
        find_installation()


def test_damaged_car(copy_of_torcs):
    car = copy_of_torcs.car("car1-trb1")
    whole = car.read_text()
    car.write_text(whole[:5000])
    with pytest.raises(ValueError, match=r"not a readable TORCS car file"):
        Physics("g-track-3", installation=copy_of_torcs)
    car.write_text(whole.replace('name="category"', 'name="kategorie"'))
    with pytest.raises(ValueError, match="names no category"):
        Physics("g-track-3", installation=copy_of_torcs)


def test_damaged_surfaces(copy_of_torcs):
    copy_of_torcs.surfaces().write_text("")
    with pytest.raises(ValueError, match=r"surfaces.xml, the road surfaces, is not the one"):
        Physics("g-track-3", installation=copy_of_torcs)


def test_a_simulation_that_outlives_its_module_ends_in_silence(torcs):
    code = (
        "import os\n"
        "from sb3_sap.envs.torcs.physics import Physics\n"
        "os.kept = Physics('wheel-2')\n"  # JAX keeps environments alive like this
        "os.kept.place(0.0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_track_without_a_road_leaves_no_trace(torcs, tmp_path):
    """TORCS builds this one without a segment; the copy of the library that did so must not be used again."""
    path = tmp_path / "empty.xml"
    path.write_bytes(flatten(torcs.track("eroad")).replace(b'name="Header"', b'name="a/b"'))
    code = (
        "from sb3_sap.envs.torcs.physics import Physics\n"
        f"try: Physics({str(path)!r})\n"
        "except ValueError as error: print(error)\n"
        "Physics('eroad').place(0.0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "empty.xml" in done.stdout


def test_a_trial_that_ends_early_fails():
    assert survives(lambda: None) is None
    assert survives(lambda: 1 / 0) == "gives up"
    assert survives(lambda: os._exit(0)) == "gives up"


def test_a_track_of_ones_own(torcs, tmp_path):
    own = tmp_path / "own.xml"
    own.write_bytes(flatten(torcs.track("g-track-3")))
    env = gym.make("sap/TorcsLaneKeeping-v0", track=str(own))
    env.reset()
    *_, info = env.step(feedback(env))
    assert info["speed_x"] > 0
    own.write_bytes(own.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"own.xml is not a readable TORCS track file"):
        gym.make("sap/TorcsLaneKeeping-v0", track=str(own))


VALUES = st.sampled_from(["0", "-1", "nan", "inf", "1e30", "-1e30", "", "x", "lft", "str", "1e-30"])


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_no_track_file_kills_the_process(torcs, tmp_path_factory, data):
    """Fuzzes the XML: lines deleted, doubled, moved, and values replaced. An exception is fine; a signal is not."""
    name = data.draw(st.sampled_from(["g-track-3", "wheel-2", "dirt-1", "corkscrew"]))
    lines = flatten(torcs.track(name)).decode().split("\n")
    for _ in range(data.draw(st.integers(1, 8))):
        i, j = (data.draw(st.integers(0, len(lines) - 1)) for _ in range(2))
        change = data.draw(st.sampled_from(["delete", "double", "swap", "value"]))
        if change == "delete" and len(lines) > 1:
            del lines[i]
        elif change == "double":
            lines.insert(i, lines[j])
        elif change == "swap":
            lines[i], lines[j] = lines[j], lines[i]
        elif 'val="' in lines[i]:
            head, _, tail = lines[i].partition('val="')
            lines[i] = f'{head}val="{data.draw(VALUES)}"{tail.partition(chr(34))[2]}'
    path = tmp_path_factory.mktemp("fuzz") / "fuzzed.xml"
    path.write_text("\n".join(lines))

    def build_and_drive():
        with contextlib.suppress(ValueError):
            simulation = Physics(path)
            simulation.drive_everywhere()
            simulation.close()
        Physics("g-track-3").drive_everywhere()

    # Longer than the trial that Physics itself makes.
    assert survives(build_and_drive, limit=60) is None


@pytest.mark.slow
def test_every_track_can_be_driven(torcs):
    assert len(torcs.tracks()) == 38
    for name in torcs.tracks():
        simulator = TorcsSimulator(name)
        state = simulator.reset(**simulator.start)
        for _ in range(30):
            state = simulator.step(min(max(2.5 * state.angle / STEERING_LOCK - 1.6 * state.track_pos, -1), 1))
        assert abs(state.track_pos) < 0.5, name
        assert simulator.track.length == pytest.approx(simulator.length, abs=0.1), name
        simulator.close()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("apt-get") is None, reason="this is not Debian")
def test_install_command(torcs, tmp_path, monkeypatch, capsys):
    root = tmp_path / "new"
    assert main(["torcs", "install", "--root", str(root)]) == 0
    assert "38 tracks" in " ".join(capsys.readouterr().out.split())
    kept = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    assert kept < 10_000_000
    monkeypatch.setenv("TORCS_ROOT", str(root))
    assert find_installation().root == root
    assert (root / DATA).is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
