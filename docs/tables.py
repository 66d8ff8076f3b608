"""Puts tables of docs/results into the pages that show them: `python docs/tables.py` after results have changed.

A page says where a table belongs and where it ends: `<!-- table: results/X/returns.md -->` and `<!-- end -->`.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TABLE = re.compile(r"(?P<begin><!-- table: (?P<path>\S+) -->\n)(?P<table>.*?)(?P<end><!-- end -->)", re.DOTALL)


def first_table(path: Path) -> str:
    """The first table of a page of results."""
    after = f"\n{path.read_text(encoding='utf-8')}".partition("\n|")[2]
    return f"|{after}".partition("\n\n")[0].strip()


def with_tables(page: Path) -> str:
    """The text of a page, its tables as they should be."""

    def put(match: re.Match[str]) -> str:
        return f"{match['begin']}\n{first_table(page.parent / match['path'])}\n\n{match['end']}"

    return TABLE.sub(put, page.read_text(encoding="utf-8"))


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_tables(page), encoding="utf-8")
