"""Puts tables of results into the pages that show them: `python docs/tables.py` after results have changed.

A page says where a table begins and ends: `<!-- table: results/X/returns.md -->` and `<!-- end -->`. The table
`presets` is made from zoo_configs.
"""

import re
from pathlib import Path

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.presets import algorithms, preset_names

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TABLE = re.compile(r"(?P<begin><!-- table: (?P<path>\S+) -->\n)(?P<table>.*?)(?P<end><!-- end -->)", re.DOTALL)


def first_table(path: Path) -> str:
    """The first table of a page of results."""
    after = f"\n{path.read_text(encoding='utf-8')}".partition("\n|")[2]
    return f"|{after}".partition("\n\n")[0].strip()


def table_of_presets() -> str:
    """Which algorithm has which presets."""
    presets = list(dict.fromkeys(name for algo in algorithms() for name in preset_names(algo)))
    lines = [f"| class | name | {' | '.join(f'`{name}`' for name in presets)} |", f"|{' --- |' * (len(presets) + 2)}"]
    for algo in sorted(algorithms(), key=lambda algo: algo not in ALGORITHMS):
        named = f"`{ALGORITHMS[algo].__name__}`" if algo in ALGORITHMS else ""
        marks = " | ".join("✓" if name in preset_names(algo) else "" for name in presets)
        lines.append(f"| {named} | `{algo}` | {marks} |")
    return "\n".join(lines)


def with_tables(page: Path) -> str:
    """The text of a page, its tables as they should be."""

    def put(match: re.Match[str]) -> str:
        of_presets = match["path"] == "presets"
        table = table_of_presets() if of_presets else first_table(ROOT / match["path"])
        return f"{match['begin']}\n{table}\n\n{match['end']}"

    return TABLE.sub(put, page.read_text(encoding="utf-8"))


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_tables(page), encoding="utf-8")
