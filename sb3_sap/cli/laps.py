"""Driving several tracks with a progress bar, and the table of the results."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from sb3_sap.benchmark.paper import TABLE_2, paper_score
from sb3_sap.envs import TRACKS
from sb3_sap.evaluation.laps import LapResult, drive_lap


def drive_tracks(policy: Any, tracks: list[str], simulator: str, console: Console) -> list[LapResult]:
    """Drives one lap of each track, showing progress."""
    with Progress(console=console, transient=True) as progress:
        return [drive_lap(policy, track, simulator, progress) for track in tracks]


def results_table(results: list[LapResult], algo: str | None = None, steps: int = 3_000) -> Table:
    """The results in the form of the paper's Table 2, beside its row of the same algorithm where there is one."""
    paper = TABLE_2.get(steps, TABLE_2[3_000]).get(algo or "", {})
    title = "One lap of each track, the actor alone"
    if paper:
        title += f"; the paper's, after {steps if steps in TABLE_2 else 3_000:,} steps, beside it"
    table = Table(title=title)
    for name in ("track", "lap done", "covered", "total reward", "score S"):
        table.add_column(name, justify="left" if name == "track" else "right", no_wrap=name == "track")
    if paper:
        table.add_column("paper: covered", justify="right", style="dim")
        table.add_column("S", justify="right", style="dim")
    for result in results:
        row = [
            TRACKS.get(result.track, result.track),
            "yes" if result.lap_done else "no",
            f"{result.covered:.1%}",
            f"{result.total_reward:,.0f}",
            f"{result.score:.3f}",
        ]
        if result.track in paper:
            lap = paper[result.track]
            row += [f"{lap.covered:.1%}", f"{paper_score(result.track, lap.total_reward):.3f}"]
        table.add_row(*row)
    return table
