"""The physics of TORCS in this process: its checks, memory, cars and tracks."""

import contextlib
import gc
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.torcs.probe import survives
from sb3_sap.envs.torcs.simulator import TorcsSimulator
from sb3_sap.envs.torcs.track_files import flatten


@pytest.mark.slow
def test_closing_frees_the_memory(torcs):
    def resident_after(times):
        for _ in range(times):
            simulation = Physics("g-track-3")
            simulation.place(0.0)
            simulation.close()
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4  # KiB

    before = resident_after(20)
    growth = []
    for _ in range(3):  # the allocator takes some pages now and then, but a leak grows every time
        after = resident_after(60)
        growth.append(after - before)
        before = after
    assert min(growth) < 1_000  # each car's parameters are 0.1 MB


def test_physics_refuses_invalid_arguments(torcs):
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
def test_readings_require_a_placed_car(torcs, reading):
    """TORCS itself would read from address 0, or from a track that was freed."""
    simulation = Physics("g-track-3")
    with pytest.raises(RuntimeError, match="place"):
        getattr(simulation, reading)
    simulation.place(0.0)
    assert math.isfinite(getattr(simulation, reading))
    simulation.close()
    with pytest.raises(RuntimeError, match="closed"):
        getattr(simulation, reading)


def test_places_off_the_road_and_factors_out_of_range_are_refused(torcs):
    simulation = Physics("g-track-3")
    for place in ((0.0, 1.5), (0.0, -1e9), (0.0, 0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 1e30)):
        with pytest.raises(ValueError, match="placed on the road"):
            simulation.place(*place)
    for factors in ({"fuel_factor": math.nan}, {"damage_factor": -1.0}, {"damage_factor": 1e30}):
        with pytest.raises(ValueError, match="_factor must lie in"):
            Physics("g-track-3", **factors)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("localedef") is None, reason="localedef is not installed")
def test_decimal_comma_of_a_locale_changes_no_number(torcs, tmp_path):
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


def test_cars_of_every_red_line_shift_gears(torcs):
    """The engines' red lines lie between 576 and 1,958 rad/s: gears depend on the car's own."""
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


@pytest.mark.slow
def test_physics_that_outlives_its_module_ends_without_an_error(torcs):
    code = (
        "import os\n"
        "from sb3_sap.envs.torcs.physics import Physics\n"
        "os.kept = Physics('wheel-2')\n"  # JAX keeps environments alive like this
        "os.kept.place(0.0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_track_without_a_road_does_not_affect_later_tracks(torcs, tmp_path):
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


def test_trial_that_ends_early_fails():
    assert survives(lambda: None) is None
    assert survives(lambda: 1 / 0) == "gives up"
    assert survives(lambda: os._exit(0)) == "gives up"


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

    # This limit is longer than that of the trial in Physics itself.
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
