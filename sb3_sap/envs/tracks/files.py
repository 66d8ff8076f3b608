"""Reading tracks: TORCS' own XML files, and the small tables (CSV) of the same facts that are shipped here."""

from __future__ import annotations

import csv
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path

from sb3_sap.common.files import atomic_path
from sb3_sap.envs.tracks.geometry import Segment, Track

#: Columns of the table. ``type`` is TORCS': str, lft, rgt. A straight fills length_m, a curve the other columns.
COLUMNS = ("type", "length_m", "radius_m", "end_radius_m", "turn_deg", "steps")

#: Maximum number of steps of a segment. TORCS' own have a few hundred at most; each takes memory and time.
MAX_STEPS = 10_000

#: Units of length and angle in track files, in m or rad.
UNITS = {"m": 1.0, "km": 1000.0, "cm": 0.01, "mm": 0.001, "ft": 0.304801, "deg": math.pi / 180, "rad": 1.0}

#: What newer and older files call the list of segments.
SEGMENT_LISTS = ("Track Segments", "segments")


def parse_table(lines: Iterable[str], name: str) -> Track:
    """Read a track from the lines of a table: ``# width_m: 12``, then CSV rows with the columns `COLUMNS`.

    :raise ValueError: naming the track, the line, and what was expected there
    """
    lines = [line.strip() for line in lines]
    widths = [line.partition(":")[2] for line in lines if line.startswith("# width_m:")]
    rows = [(number, line) for number, line in enumerate(lines, 1) if line and not line.startswith("#")]
    if not widths or not rows or tuple(rows[0][1].split(",")) != COLUMNS:
        raise ValueError(f"Track table {name!r} must begin with '# width_m: ...' and the columns {','.join(COLUMNS)}.")
    segments = []
    for number, line in rows[1:]:
        values = dict(zip(COLUMNS, next(csv.reader([line])), strict=False))
        kind = values.pop("type")
        numbers = {key: _number(value, f"{name}, line {number}: {key}") for key, value in values.items() if value}
        numbers["turn"] = math.radians(numbers.pop("turn_deg", 0.0))
        segments.append(_segment(kind, numbers, f"{name}, line {number}"))
    return Track(name, _number(widths[0], f"{name}: width_m"), segments)


def write_table(track: Track, path: str | Path) -> None:
    """Write the table that `parse_table` reads back as the same track."""
    with atomic_path(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        file.write(f"# width_m: {track.width!r}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for segment in track.segments:
            if not segment.turn:
                writer.writerow(("str", f"{segment.length:.12g}", "", "", "", segment.steps))
                continue
            end_radius = "" if segment.end_radius == segment.radius else f"{segment.end_radius:.12g}"
            turn = f"{abs(math.degrees(segment.turn)):.12g}"
            side = "lft" if segment.turn > 0 else "rgt"
            writer.writerow((side, "", f"{segment.radius:.12g}", end_radius, turn, segment.steps))


def read_track_xml(path: str | Path) -> Track:
    """Read the plan of a TORCS track file (``tracks/road/*/*.xml``).

    The files claim UTF-8 but hold Latin-1 bytes, and pull in surfaces and objects as external entities. Neither matters
    for the plan: the document type is cut off and the entities dropped, so nothing outside the file is ever read.

    :raise ValueError: if the file is damaged or lacks what a plan needs, saying what
    """
    path = Path(path)
    text = path.read_bytes().decode("latin-1")
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"<\?xml.*?\?>|<!DOCTYPE[^\[>]*(\[.*?\]\s*)?>", "", text, flags=re.DOTALL)
    text = re.sub(r"&[\w.-]+;", "", text)
    try:
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a readable TORCS track file: {error}.") from error
    main = root.find("section[@name='Main Track']")
    lists = [] if main is None else [main.find(f"section[@name='{name}']") for name in SEGMENT_LISTS]
    sections = [section for found in lists if found is not None for section in found.findall("section")]
    if main is None or not sections:
        raise ValueError(f"{path} has no section 'Main Track' with 'Track Segments': not a TORCS track file.")
    step_length = _attribute(main, "profil steps length", path)
    segments = [_xml_segment(section, step_length, path) for section in sections]
    return Track(path.stem, _attribute(main, "width", path) or math.nan, segments)


def _xml_segment(section: ElementTree.Element, step_length: float | None, path: Path) -> Segment:
    kind = section.find("attstr[@name='type']")
    names = ("lg", "radius", "end radius", "arc", "profil steps", "profil steps length")
    found = {name: value for name in names if (value := _attribute(section, name, path)) is not None}
    renamed = {"lg": "length_m", "radius": "radius_m", "end radius": "end_radius_m", "arc": "turn"}
    numbers = {renamed[name]: value for name, value in found.items() if name in renamed}
    place = f"{path}, segment {section.get('name')!r}"
    segment = _segment("" if kind is None else kind.get("val", ""), numbers, place)
    # A number of steps takes precedence over a length of steps, and the segment's length over the track's.
    steps = found.get("profil steps", 1)
    step_length = found.get("profil steps length", step_length)
    if steps == 1 and step_length:
        steps = int(min(segment.length / step_length, MAX_STEPS)) + 1
    if not 1 <= steps <= MAX_STEPS:
        raise ValueError(f"{place}: it is cut into {steps:g} steps; expected 1 to {MAX_STEPS}.")
    return segment._replace(steps=int(steps))


def _attribute(section: ElementTree.Element, name: str, path: Path) -> float | None:
    element = section.find(f"attnum[@name='{name}']")
    if element is None:
        return None
    place = f"{path}, section {section.get('name')!r}: {name}"
    unit = element.get("unit")
    if unit is not None and unit not in UNITS:
        raise ValueError(f"{place} is given in {unit!r}; expected one of {', '.join(UNITS)}.")
    return _number(element.get("val", ""), place) * UNITS.get(unit or "m", 1.0)


def _segment(kind: str, numbers: dict[str, float], place: str) -> Segment:
    if kind not in ("str", "lft", "rgt"):
        raise ValueError(f"{place}: type must be str, lft or rgt, got {kind!r}.")
    needed = ("length_m",) if kind == "str" else ("radius_m", "turn")
    steps = numbers.get("steps", 1)
    if any(value <= 0 for value in (*(numbers.get(key, 0) for key in needed), numbers.get("end_radius_m", 1), steps)):
        raise ValueError(f"{place}: a segment of type {kind} needs positive values for {' and '.join(needed)}.")
    if kind == "str":
        return Segment.straight(numbers["length_m"], int(steps))
    turn = numbers["turn"] if kind == "lft" else -numbers["turn"]
    return Segment.curve(turn, numbers["radius_m"], numbers.get("end_radius_m"), int(steps))


def _number(text: str, place: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{place} must be a number, got {text.strip()!r}.")
    return number
