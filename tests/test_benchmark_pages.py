"""The committed results: their pages lead somewhere, and the commands that they print exist."""

import re
import shlex
from pathlib import Path

import pytest

from sb3_sap import zoo
from sb3_sap.benchmark.configurations import parse_configurations
from sb3_sap.benchmark.store import ARCHIVE
from sb3_sap.cli.main import parser

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"
PAGES = sorted(RESULTS.rglob("*.md"))
TEXTS = {path.relative_to(RESULTS).as_posix(): path.read_text(encoding="utf-8") for path in PAGES}


def commands(text):
    """Commands of this package in code blocks and between backticks."""
    blocks = re.findall(r"^```\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.replace("\\\n", "").splitlines()]
    inline = re.findall(r"`(sb3-sap [^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    return [line for line in [*lines, *inline] if line.startswith("sb3-sap ")]


COMMANDS = [(page, command) for page, text in TEXTS.items() for command in commands(text)]


@pytest.mark.parametrize("page", TEXTS)
def test_links_lead_somewhere(page):
    targets = re.findall(r"\]\(((?!https?:)[^)#]+)", TEXTS[page])
    assert [target for target in targets if not ((RESULTS / page).parent / target).exists()] == []


def test_commands_are_understood():
    assert len(COMMANDS) > 50
    for _, command in COMMANDS:
        arguments = shlex.split(command.replace("ENV_ID", "Acrobot-v1"))[1:]
        if arguments[0] not in zoo.COMMANDS:  # which RL Zoo parses itself
            options = parser().parse_args(arguments)  # exits with 2 where it does not understand
            parse_configurations(getattr(options, "configurations", []))


def test_every_folder_with_runs_is_in_the_index():
    folders = {path.parent.name for path in RESULTS.glob(f"*/{ARCHIVE}")}
    assert folders
    assert folders <= set(re.findall(r"\]\(([\w-]+)/", TEXTS["README.md"]))


def test_every_page_is_reached_from_the_index():
    reached, found = set(), {RESULTS / "README.md"}
    while found - reached:
        page = (found - reached).pop()
        reached.add(page)
        targets = re.findall(r"\]\(((?!https?:)[^)#]+\.md)", page.read_text(encoding="utf-8"))
        found |= {path for target in targets if (path := (page.parent / target).resolve()).is_relative_to(RESULTS)}
    assert sorted(set(PAGES) - reached) == []
