"""The ledger of sealed seeds, and the runs that are archived."""

import itertools
import json
import re
from pathlib import Path

from sb3_sap.benchmark import store

RESULTS = Path(__file__).parent.parent / "results"
ROW = re.compile(r"^\| (\d+)–(\d+) \| .+ \| (.+) \|$", re.MULTILINE)


def ledger():
    """(first seed, last seed, what froze the settings) of each row."""
    rows = ROW.findall((RESULTS / "SEALED.md").read_text(encoding="utf-8"))
    return [(int(first), int(last), frozen) for first, last, frozen in rows]


def may_be_reported(seed, rows):
    """Whether the ledger says that the seed was opened: spent, or after a commit that froze the settings."""
    frozen = [frozen for first, last, frozen in rows if first <= seed <= last]
    return bool(frozen) and all(text == "spent" or re.fullmatch(r"[0-9a-f]{10}", text) for text in frozen)


def test_ledger_tells_opened_seeds_from_sealed_ones():
    rows = [(0, 9, "spent"), (100, 999, "never in a report"), (1000, 1019, "sealed"), (1020, 1039, "0123456789")]
    assert [may_be_reported(seed, rows) for seed in (9, 10, 500, 1000, 1030)] == [True, False, False, False, True]


def test_ledger_has_rows_that_do_not_overlap():
    rows = sorted(ledger())
    assert len(rows) >= 4
    assert all(before[1] < after[0] for before, after in itertools.pairwise(rows))


def test_every_archived_run_has_a_seed_that_the_ledger_opened():
    rows = ledger()
    archives = sorted(RESULTS.glob(f"*/{store.ARCHIVE}"))
    assert archives
    for archive in archives:
        seeds = {json.loads(line)["run"]["seed"] for line in store.read_archive(archive.parent).values()}
        assert {seed for seed in seeds if not may_be_reported(seed, rows)} == set(), archive
