"""``sb3-sap torcs install | check | replay``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from rich.console import Console

from sb3_sap.common.files import atomic_path

#: Time driven by ``check``, s.
CHECK_SECONDS = 5.0


def add_torcs(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the commands to the main parser."""
    torcs = commands.add_parser("torcs", help="install, check and verify TORCS, the reference simulator")
    actions = torcs.add_subparsers(title="commands", required=True, metavar="COMMAND")
    command = actions.add_parser("install", help="fetch Debian's packages and keep the 3 MB that are needed; no root")
    command.add_argument("--root", type=Path, help="folder to install into; set TORCS_ROOT to it afterwards")
    command.set_defaults(run=_install)
    command = actions.add_parser("check", help="say which TORCS is found, and drive it for 5 seconds")
    command.set_defaults(run=_check)
    command = actions.add_parser(
        "replay",
        help="replay what a robot logged in the real race engine, and compare every row",
        description="Exits with 0 if x and y have the same bits at every row, with 1 if not.",
    )
    command.add_argument("trace", type=Path, help="NAME.csv.gz")
    command.add_argument("--start", type=Path, required=True, help="JSON of start conditions, with an entry NAME")
    command.add_argument("--json", type=Path, help="file of the comparison")
    command.set_defaults(run=_replay)


def _install(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.envs.torcs.download import install
    from sb3_sap.envs.torcs.installation import user_root

    with console.status("downloading about 330 MB …"):
        found = install(options.root or user_root())
    console.print(f"TORCS is in {found.root}, with {len(found.tracks())} tracks and {len(found.cars())} cars.")
    if options.root:
        console.print(f"Set TORCS_ROOT={options.root} for it to be found.")
    return 0


def _check(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.envs.torcs.installation import VERSION, find_installation
    from sb3_sap.envs.torcs.simulator import TorcsSimulator

    found = find_installation()
    console.print(f"TORCS {VERSION} in {found.root}")
    console.print(f"{len(found.tracks())} tracks: {', '.join(found.tracks())}")
    simulator = TorcsSimulator("wheel-2")
    state = simulator.reset(**simulator.start)
    steps = round(CHECK_SECONDS / simulator.control_step)
    begin = time.perf_counter()
    for _ in range(steps):
        state = simulator.step(state.angle - state.track_pos)
    seconds = time.perf_counter() - begin
    simulator.close()
    console.print(
        f"Drove {CHECK_SECONDS:g} s on wheel-2 at {state.speed_x:.1f} km/h: {CHECK_SECONDS / seconds:,.0f}× real time, "
        f"{steps / seconds:,.0f} control steps of {simulator.control_step} s a second"
    )
    return 0


def _replay(options: argparse.Namespace, console: Console) -> int:
    from sb3_sap.envs.torcs.replay import replay, to_json

    found = replay(options.trace, options.start)
    first = "none" if found.first_difference is None else str(found.first_difference)
    console.print(f"{found.trace}: {found.identical_rows} of {found.rows} rows identical in x and y to the bit")
    console.print(f"first row that differs: {first}; identical in every column: {found.all_columns_identical_rows}")
    for column, deviation in found.largest_deviation.items():
        console.print(f"  {column:14} largest deviation {deviation:g}")
    if options.json:
        with atomic_path(options.json) as temporary:
            temporary.write_text(to_json(found), encoding="utf-8")
    return 0 if found.identical else 1
