"""What README and docs say must be so."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("path", "table"), re.findall(r"<!-- table: (\S+) -->\n(.*?)<!-- end -->", README, re.DOTALL))
def test_tables_are_those_of_the_results(path, table):
    assert table.strip() == (ROOT / path).read_text(encoding="utf-8").strip()


@pytest.mark.parametrize("target", re.findall(r"\]\(((?!https?:)[^)#]+)\)", README))
def test_links_lead_somewhere(target):
    assert (ROOT / target).exists()


@pytest.mark.parametrize("number", range(3))
def test_snippets_compile_and_the_quick_ones_run(number, tmp_path, monkeypatch):
    """The README's Python, in order; long trainings cut to 300 steps, the progress bar left out."""
    snippets = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(snippets) == 3
    monkeypatch.chdir(tmp_path)
    code = "\n".join(snippets[number : number + 1] if number < 2 else [snippets[0], snippets[2]])
    code, cuts = re.subn(r"\.learn\([\d_]+", ".learn(300", code)
    assert cuts == 1
    names = {}
    exec(compile(code.replace(", progress_bar=True", ""), "README.md", "exec"), names)
    assert names["model"].num_timesteps == 300


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_run_and_hold_no_outputs(path):
    cells = [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert not any(cell["outputs"] or cell["execution_count"] for cell in cells)
    names = {}
    for cell in cells:
        lines = [line for line in cell["source"] if not line.startswith("%")]
        exec(compile("".join(lines), path.name, "exec"), names)
    assert names["model"].validation_accuracy > 0.7
