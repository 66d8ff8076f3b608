"""What README and docs say must be so."""

import json
import re
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

matplotlib.use("agg")

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


#: The constants at the top of each notebook, cut to what shows that its cells run; 01 runs as it is.
NOTEBOOKS = {
    "01_action_permissibility": {},
    "02_lane_keeping": {"STEPS": 300, "TEST_TRACKS": ["g-track-3"]},
    "03_your_own_problem": {"STEPS": 1_200, "TRIALS": 2},
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name.startswith("01") else pytest.mark.slow) for name in NOTEBOOKS],
)
def test_notebooks_run_and_hold_no_outputs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert not any(cell["outputs"] or cell["execution_count"] for cell in cells)
    names = {}
    for number, cell in enumerate(cells):
        lines = [line for line in cell["source"] if not line.startswith("%")]
        exec(compile("".join(lines), name, "exec"), names)
        if number == 0:
            assert NOTEBOOKS[name].keys() <= names.keys()
            names |= NOTEBOOKS[name]
    assert names["model"].validation_accuracy > 0.7
    plt.close("all")


def test_every_notebook_is_run():
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} == NOTEBOOKS.keys()
