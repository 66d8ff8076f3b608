"""Writes pages: a table or figure, and the command, versions, machine and dates that made it."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from sb3_sap.benchmark.reports.results import Results
from sb3_sap.common.files import atomic_path

DPI = 120


def markdown(table: pd.DataFrame) -> str:
    """A Markdown table whose header row is the column names."""
    rows = [list(table.columns), ["---"] * table.shape[1], *table.astype(str).to_numpy().tolist()]
    return "".join("| " + " | ".join(row) + " |\n" for row in rows)


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Writes a table as CSV atomically."""
    with atomic_path(path) as temporary:
        table.to_csv(temporary, index=False)


def write_figure(path: Path, figure: Figure) -> None:
    """Writes a figure as SVG atomically, with the same bytes for the same figure."""
    figure.set_dpi(DPI)
    figure.draw_without_rendering()  # because the constrained layout settles in the second pass
    with atomic_path(path) as temporary, rc_context({"svg.hashsalt": path.stem}):
        figure.savefig(temporary, dpi=DPI, metadata={"Date": None})


def write_page(path: Path, title: str, parts: list[str], results: Results, command: str) -> None:
    """Writes a Markdown page atomically."""
    write_text(path, "\n".join([f"# {title}\n", *parts, made_by(results, command)]))


def made_by(results: Results, command: str) -> str:
    """The last paragraph of a page: its provenance."""
    text = f"Made by `{command}`, from {len(results.made)} runs"
    dates = sorted({made["date"] for made in results.made})
    text += f" of {dates[0]}" + (f" to {dates[-1]}" if len(dates) > 1 else "")
    revisions = sorted({made["revision"] for made in results.made if made["revision"]})
    text += f", revision {_listed(revisions)}" if revisions else ""
    text += f", on {_listed(sorted({made['machine'] for made in results.made}))}"
    versions = sorted({f"{name} {number}" for made in results.made for name, number in made["versions"].items()})
    text += f", one thread each. {', '.join(versions)}."
    if results.missing:
        missing = ", ".join(f"{number} of {name}" for name, number in results.missing.items())
        text += f"\n\nRuns that were not made: {missing}."
    return text + "\n"


def _listed(items: list[str]) -> str:
    return " and ".join(items)
