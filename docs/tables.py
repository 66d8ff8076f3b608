"""Fills the tables and the code that pages show from their sources: `python docs/tables.py` after a source has changed.

A page names the source, and the script fills what lies between the two comments::

    <!-- table: torcs-3000/headline.md rows: ddpg_ap:fast ddpg:default --> ... <!-- end -->
    <!-- table: presets --> ... <!-- end -->
    <!-- code: examples/quick_start.py --> ... <!-- end -->

The first is the first table of a page of results, or the named rows of it in the order given, and with `columns:` after
them the named columns; the second is made from
zoo_configs; the third is a whole file.
"""

import re
import shlex
from pathlib import Path

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.presets import algorithms, preset_names

ROOT = Path(__file__).parent.parent
#: Where the pages of results are: the only place that says so to the markers.
RESULTS = ROOT / "results"
PAGES = [
    ROOT / "README.md",
    *(page for folder in ("docs", "docs/algorithms") for page in sorted((ROOT / folder).glob("*.md"))),
]
MARKER = re.compile(
    r"(?P<begin><!-- (?P<kind>table|code): (?P<source>\S+)"
    r"(?: rows: (?P<rows>.+?))?(?: columns: (?P<columns>.+?))? -->\n).*?(?P<end><!-- end -->)",
    re.DOTALL,
)


def first_table(path: Path) -> list[str]:
    """The lines of the first table of a page of results."""
    after = f"\n{path.read_text(encoding='utf-8')}".partition("\n|")[2]
    return f"|{after}".partition("\n\n")[0].strip().splitlines()


def table_of_results(source: str, rows: str | None, columns: str | None) -> str:
    """A table of results, or the rows whose first cells are given, and the columns whose headings are, as a shell would
    split them.

    :raise ValueError: for a row or a column that the table does not have
    """
    header, line, *body = first_table(RESULTS / source)
    if rows is not None:
        named = {row.split("|")[1].strip(): row for row in body}
        wanted = shlex.split(rows)
        if missing := [name for name in wanted if name not in named]:
            raise ValueError(f"{source} has no row {missing[0]!r}: its rows are {', '.join(map(repr, named))}.")
        body = [named[name] for name in wanted]
    lines = [header, line, *body]
    if columns is not None:
        cells = [[cell.strip() for cell in row.strip().removeprefix("|").removesuffix("|").split("|")] for row in lines]
        chosen = [cells[0].index(name) for name in shlex.split(columns)]
        lines = [f"| {' | '.join(row[number] for number in chosen)} |" for row in cells]
    return "\n".join(lines)


def table_of_presets() -> str:
    """Which algorithm has which presets."""
    presets = list(dict.fromkeys(name for algo in algorithms() for name in preset_names(algo)))
    lines = [f"| class | name | {' | '.join(f'`{name}`' for name in presets)} |", f"|{' --- |' * (len(presets) + 2)}"]
    classes: dict[str, type] = {**ALGORITHMS, **ON_POLICY_ALGORITHMS}
    for algo in sorted(algorithms(), key=lambda algo: algo not in classes):
        named = f"`{classes[algo].__name__}`" if algo in classes else ""
        marks = " | ".join("✓" if name in preset_names(algo) else "" for name in presets)
        lines.append(f"| {named} | `{algo}` | {marks} |")
    return "\n".join(lines)


def filled(page: Path) -> str:
    """The text of a page with its tables and its code as their sources have them."""

    def fill(match: re.Match[str]) -> str:
        if match["kind"] == "code":
            code = (ROOT / match["source"]).read_text(encoding="utf-8")
            return f"{match['begin']}```python\n{code}```\n{match['end']}"
        if match["source"] == "presets":
            content = table_of_presets()
        else:
            content = table_of_results(match["source"], match["rows"], match["columns"])
        return f"{match['begin']}\n{content}\n\n{match['end']}"

    return MARKER.sub(fill, page.read_text(encoding="utf-8"))


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page), encoding="utf-8")
