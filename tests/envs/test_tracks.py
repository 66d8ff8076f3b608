"""Tracks: geometry as in a drawing on paper, the shipped and the generated ones, and their files."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_sap.envs.tracks import TRACKS, Segment, Track, generate_track, get_track, read_track_xml, write_table

QUARTER = math.pi / 2

# TORCS' own figures: length m, width m, smallest radius m, segments, sub-segments
TORCS_FIGURES = {
    "wheel-2": (6205.46, 12, 15, 59, 1200),
    "eroad": (3260.43, 16, 40, 43, 402),
    "spring": (22129.77, 12, 20, 227, 2956),
    "g-track-3": (2843.10, 10, 30, 39, 350),
    "ole-road-1": (6282.81, 10, 30, 71, 724),
}


@pytest.fixture
def stadium() -> Track:
    """100 m east, a left half circle of radius 10 m, 100 m back west, another half circle."""
    half = Segment.curve(math.pi, 10)
    return Track("stadium", 8, [Segment.straight(100), half, Segment.straight(100), half])


def test_stadium_is_laid_as_drawn(stadium: Track) -> None:
    assert stadium.length == pytest.approx(200 + 20 * math.pi)
    assert stadium.gap == pytest.approx(0, abs=1e-9)
    assert stadium.position(50, 1) == pytest.approx((50, 1, 0))  # left of eastbound is north
    assert stadium.position(100 + 5 * math.pi) == pytest.approx((110, 10, QUARTER))  # a quarter into the curve
    assert stadium.position(100 + 5 * math.pi, 2) == pytest.approx((108, 10, QUARTER))  # left is inwards
    assert stadium.position(150 + 10 * math.pi) == pytest.approx((50, 20, math.pi))
    assert stadium.position(stadium.length + 50) == pytest.approx(stadium.position(50))


def test_right_curve_bends_south() -> None:
    piece = Track("bend", 8, [Segment.curve(-QUARTER, 10)]).pieces[0]
    assert piece.point(piece.length) == pytest.approx((10, -10, -QUARTER))
    assert piece.project(10 + 1, -10) == pytest.approx((piece.length, 1))  # southbound, left is east


def test_changing_radius_is_laid_in_equal_steps_that_make_the_turn() -> None:
    segment = Segment.curve(3.0, 20, 40, steps=3)  # radii 20, 30, 40
    (a, b, c), curvatures = zip(*segment.arcs(), strict=True)
    assert a == b == c
    assert curvatures == pytest.approx((1 / 20, 1 / 30, 1 / 40))
    assert sum(length * curvature for length, curvature in segment.arcs()) == pytest.approx(3.0)


@given(distance=st.floats(0, 6205), offset=st.floats(-6, 6), moved=st.floats(-60, 60))
def test_locate_inverts_position_from_any_piece_nearby(distance: float, offset: float, moved: float) -> None:
    track = get_track("wheel-2")
    x, y, heading = track.position(distance, offset)
    found, lateral, found_heading, piece = track.locate(x, y, track.piece_at(distance + moved))
    # At the start line the plan has a gap of 0.26 m, and some points have two addresses.
    tolerance = 0.3 if min(found, track.length - found) < 7 else 1e-6
    assert (found - distance + 1000) % track.length - 1000 == pytest.approx(0, abs=tolerance)
    assert lateral == pytest.approx(offset, abs=tolerance)
    assert math.cos(found_heading - heading) == pytest.approx(1)
    assert track.pieces[piece].start <= found + tolerance


def test_locate_follows_the_given_piece_where_wheel_2_crosses_itself() -> None:
    track = get_track("wheel-2")
    places = np.arange(0, track.length, 5.0)
    plan = np.array([track.position(s)[:2] for s in places])
    far = np.abs(places[:, None] - places) > 200
    near = np.linalg.norm(plan[:, None] - plan, axis=2) < 5
    crossing = np.argwhere(near & far & (np.abs(places[:, None] - places) < track.length - 200))
    here, there = places[crossing[0]]
    x, y, _ = track.position(here)
    assert track.locate(x, y, track.piece_at(here - 10))[0] == pytest.approx(here)
    assert track.locate(x, y, track.piece_at(there - 10))[0] == pytest.approx(there, abs=6)


@pytest.mark.parametrize("name", TORCS_FIGURES)
def test_shipped_tracks_have_the_figures_of_torcs(name: str) -> None:
    length, width, radius, segments, sub_segments = TORCS_FIGURES[name]
    track = get_track(name)
    assert track.length == pytest.approx(length, abs=0.05)  # TORCS adds up in single precision
    assert (track.width, track.min_radius) == (width, radius)
    assert (len(track.segments), sum(segment.steps for segment in track.segments)) == (segments, sub_segments)
    assert track.gap < (0.27 if name == "wheel-2" else 0.04)
    end = track.pieces[-1]
    turned = end.heading + end.curvature * end.length
    assert math.cos(turned) == pytest.approx(1)  # facing as at the start


def test_every_shipped_track_is_checked() -> None:
    assert set(TRACKS) == set(TORCS_FIGURES)


@given(seed=st.integers(0, 10_000))
def test_generated_tracks_close_and_can_be_driven(seed: int) -> None:
    track = generate_track(seed)
    end = track.pieces[-1]
    assert track.gap < 1e-6
    assert abs(end.heading + end.curvature * end.length) == pytest.approx(2 * math.pi)  # once around
    assert track.min_radius >= 25
    assert track.segments[0].turn == 0  # it starts on a straight
    assert track.segments == get_track(f"random:{seed}").segments


def test_generated_tracks_differ_by_seed() -> None:
    assert generate_track(1).length != generate_track(2).length
    assert get_track("random").segments == generate_track(0).segments


@pytest.mark.parametrize("seed", [-1, 1.5, True, "1"])
def test_invalid_seed_of_a_generated_track_is_refused(seed: object) -> None:
    with pytest.raises(ValueError, match="seed of a generated track must be a non-negative integer"):
        generate_track(seed)  # type: ignore[arg-type]


def test_table_is_read_back_as_written(tmp_path: Path) -> None:
    track = get_track("wheel-2")
    write_table(track, tmp_path / "copy.csv")
    copy = get_track(tmp_path / "copy.csv")
    assert (copy.name, copy.width) == ("copy", track.width)
    assert np.array(copy.segments) == pytest.approx(np.array(track.segments))
    assert get_track(copy) is copy


XML = """<?xml version="1.0" encoding="UTF-8"?>
<!-- &not-even-here; -->
<!DOCTYPE params SYSTEM "params.dtd" [
<!-- [general] definitions -->
<!ENTITY secret SYSTEM "file:///etc/passwd">
<!ENTITY bomb "&secret;&secret;">
]>
<params name="é">
  <section name="Surfaces">&secret;&bomb;</section>
  <section name="Main Track">
    <attnum name="width" unit="m" val="12.0"/>
    <attnum name="profil steps length" unit="m" val="4.0"/>
    <section name="Track Segments">
      <section name="1"><attstr name="type" val="str"/><attnum name="lg" unit="m" val="10"/></section>
      <section name="2">
        <attstr name="type" val="rgt"/><attnum name="arc" unit="deg" val="90"/>
        <attnum name="radius" unit="m" val="20"/><attnum name="end radius" unit="m" val="40"/>
        <attnum name="profil steps" val="3"/>
      </section>
      <section name="3">
        <attstr name="type" val="lft"/><attnum name="arc" val="1"/><attnum name="radius" unit="m" val="30"/>
      </section>
    </section>
  </section>
</params>
"""


def _write(folder: Path, text: str) -> Path:
    path = folder / "course.xml"
    path.write_bytes(text.encode("latin-1"))  # as the files of TORCS are, whatever they declare
    return path


def test_torcs_xml_is_read_into_segments(tmp_path: Path) -> None:
    track = get_track(_write(tmp_path, XML))
    assert (track.name, track.width) == ("course", 12)
    assert track.segments == (
        Segment.straight(10, steps=3),  # int(10 / 4) + 1
        Segment.curve(-QUARTER, 20, 40, steps=3),
        Segment.curve(1, 30, steps=8),  # int(30 / 4) + 1
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (XML[:-40], "is not a readable TORCS track file"),
        ("<params/>", "has no section 'Main Track'"),
        (XML.replace('val="rgt"', 'val="rigth"'), "segment '2': type must be str, lft or rgt, got 'rigth'"),
        (XML.replace('name="lg"', 'name="length"'), "segment '1': a segment of type str needs positive values"),
        (XML.replace('val="20"', 'val="wide"'), "section '2': radius must be a number, got 'wide'"),
        (XML.replace('unit="deg"', 'unit="grad"'), "arc is given in 'grad'; expected one of m, km"),
        (
            XML.replace('steps" val="3"', 'steps" val="1e30"'),
            r"segment '2': it is cut into 1e\+30 steps; expected 1 to",
        ),
        (XML.replace('unit="m" val="4.0"', 'unit="m" val="1e-320"'), "segment '1': it is cut into 10001 steps"),
        (XML.replace('name="width"', 'name="wide"'), "width of track 'course' must be a positive number"),
    ],
)
def test_damaged_xml_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_track_xml(_write(tmp_path, text))


HEAD = "# width_m: 12\ntype,length_m,radius_m,end_radius_m,turn_deg,steps\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "Track table 'course' must begin with '# width_m: ...'"),
        (HEAD + "str,long,,,,1", "course, line 3: length_m must be a number, got 'long'"),
        (HEAD + "lft,,10,,,1", "course, line 3: a segment of type lft needs positive values for radius_m and turn"),
        (HEAD, "at least one segment, got none"),
    ],
)
def test_damaged_table_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "course.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        get_track(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("weel-2", "did you mean 'wheel-2'"),
        ("E-Road", "'eroad'"),
        ("random:x", "'random:SEED'"),
        ("?", "choose one of"),
    ],
)
def test_unknown_track_names_the_nearest(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        get_track(name)
