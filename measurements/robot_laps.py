"""Measures the lap times of TORCS' own robots, in the real race engine, without a display.

Each robot drives alone, as its own program with the settings that it brings, the car of sap/TorcsRacing-v0 with that
environment's skill level, without fuel use or damage. The first lap begins at rest; TORCS counts it from the green
light, so it contains the way from the grid to the line. The second is a flying lap.

TORCS must be there as a whole: `apt-get install torcs`, or Debian's packages torcs, torcs-data, libplib1, libopenal1,
libopenal-data, libvorbisfile3, libvorbis0a, libogg0 and libsndio7.0, got with `apt-get download`, each unpacked with
`dpkg-deb -x PACKAGE.deb DIR`.

python measurements/robot_laps.py [--root DIR] [--out results/robot_laps.csv]   # writes .csv and .md
"""

import argparse
import os
import re
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pandas as pd

from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text
from sb3_sap.envs.torcs.installation import DATA, LIBRARIES
from sb3_sap.envs.tracks import TRACKS

CAR, SKILL = "car1-trb1", "rookie"
#: The robots that TORCS ships with this car, and which of their drivers has it.
ROBOTS = {"berniw": 3, "bt": 2, "inferno": 3, "lliaw": 3, "olethros": 2, "tita": 3}
LAPS = 2
#: Seconds after which a race that has not ended is given up.
PATIENCE = 300
#: Races of the engine. Tracks with a starting grid of their own take that.
RACE = """<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE params SYSTEM "params.dtd">
<params name="Practice" type="param" mode="mw">
  <section name="Header"><attstr name="name" val="Practice"/><attstr name="description" val="Practice"/></section>
  <section name="Tracks">
    <attnum name="maximum number" val="1"/>
    <section name="1"><attstr name="name" val="{track}"/><attstr name="category" val="road"/></section>
  </section>
  <section name="Races"><section name="1"><attstr name="name" val="Practice"/></section></section>
  <section name="Practice">
    <attnum name="laps" val="{laps}"/>
    <attstr name="type" val="practice"/>
    <attstr name="starting order" val="drivers list"/>
    <attstr name="display mode" val="results only"/>
    <attstr name="display results" val="no"/>
    <attnum name="fuel consumption factor" val="0"/>
    <attnum name="damage factor" val="0"/>
    <section name="Starting Grid">
      <attnum name="rows" val="1"/>
      <attnum name="distance to start" val="100"/>
      <attnum name="initial speed" val="0"/>
      <attnum name="initial height" val="0.2"/>
    </section>
  </section>
  <section name="Drivers">
    <attnum name="maximum number" val="1"/>
    <section name="1"><attnum name="idx" val="{driver}"/><attstr name="module" val="{robot}"/></section>
  </section>
</params>
"""


def race(root: Path, robot: str, driver: int, track: str) -> list[dict[str, float]]:
    """Races alone and returns time (s), top speed (m/s) and damage of each completed lap."""
    data, libraries = root / DATA, root / LIBRARIES / "torcs"
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder)
        shutil.copytree(data / "config", local / "config")
        own = local / "drivers" / robot / f"{robot}.xml"  # which TORCS prefers to its own
        own.parent.mkdir(parents=True)
        shutil.copy(own_driver(data / "drivers" / robot / f"{robot}.xml", driver, local), own)
        (local / "race.xml").write_text(RACE.format(track=track, laps=LAPS, robot=robot, driver=driver))
        command = [str(libraries / "torcs-bin"), *map(str, ("-l", local, "-L", libraries, "-D", data))]
        command += ["-r", str(local / "race.xml")]
        found = [str(libraries / "lib"), str(root / LIBRARIES), os.environ.get("LD_LIBRARY_PATH", "")]
        environment = {**os.environ, "LD_LIBRARY_PATH": ":".join(found)}
        try:
            subprocess.run(command, cwd=data, env=environment, timeout=PATIENCE, capture_output=True, check=False)
        except subprocess.TimeoutExpired:
            return []
        results = list((local / "results").rglob("results*.xml"))
        return laps(results[0]) if results else []


def own_driver(path: Path, driver: int, folder: Path) -> Path:
    """A copy of a robot's file with the skill level of the environment; its driver must have the car."""
    text = path.read_bytes().decode("latin-1")
    start = re.search(rf'<section name="{driver}">', text)
    end = text.find("</section>", start.end()) if start else -1
    if start is None or f'val="{CAR}"' not in text[start.end() : end]:
        raise SystemExit(f"Driver {driver} of {path} does not drive {CAR}: name another one in ROBOTS.")
    body = re.sub(r'<attstr name="skill level"[^>]*/>', "", text[start.end() : end])
    copy = folder / "robot.xml"
    skilled = f'{text[: start.end()]}<attstr name="skill level" val="{SKILL}"/>{body}{text[end:]}'
    copy.write_bytes(skilled.encode("latin-1"))
    return copy


def laps(path: Path) -> list[dict[str, float]]:
    """The laps of a practice's results."""
    text = re.sub(r"<!DOCTYPE[^>]*>|<\?xml.*?\?>", "", path.read_text(encoding="latin-1"))
    practice = ElementTree.fromstring(text.strip()).find(".//section[@name='Practice']")
    sections = [] if practice is None else practice.findall("section")
    return [{item.get("name", ""): float(item.get("val", 0)) for item in section} for section in sections]


def main(root: Path, out: Path) -> None:
    """Races every robot on every track, and writes the laps, then the table of the flying ones."""
    rows = []
    for track in TRACKS:
        for robot, driver in ROBOTS.items():
            done = race(root, robot, driver, track)
            for number in range(LAPS):
                lap = done[number] if number < len(done) and done[number].get("time") else {}
                damage = lap.get("dammages")
                rows.append(
                    {"track": track, "robot": robot, "lap": number + 1, "time_s": lap.get("time"), "damage": damage}
                )
            print(track, robot, [lap.get("time") for lap in done], flush=True)
            write_csv(out, pd.DataFrame(rows))
    table = pd.DataFrame(rows)
    pages = []
    for number, title in ((2, "The second lap, flying, s"), (1, "The first lap, from the grid at rest, s")):
        wide = table[table["lap"] == number].pivot(index="robot", columns="track", values="time_s")[list(TRACKS)]
        shown = wide.map(lambda time: "not completed" if pd.isna(time) else f"{time:.1f}")
        pages.append(f"{title}:\n\n{markdown(shown.reset_index())}")
    made = provenance()
    text = "# Lap times of TORCS' robots\n\n" + "\n".join(pages)
    text += (
        f"\nTORCS 1.3.7 in its own race engine: {CAR}, skill level {SKILL}, without fuel use or damage, each robot "
        "alone and with its own settings of the car. inferno, lliaw and tita drive alike. Made by "
        f"`python measurements/robot_laps.py` on {made['date']}, revision {made['revision']}.\n"
    )
    write_text(out.with_suffix(".md"), text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("/"), help="where TORCS is")
    parser.add_argument("--out", type=Path, default=Path("results/robot_laps.csv"))
    options = parser.parse_args()
    main(options.root.resolve(), options.out)
