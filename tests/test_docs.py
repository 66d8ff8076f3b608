"""What README and docs say must be so."""

import inspect
import json
import re
import runpy
import shlex
import textwrap
from pathlib import Path

import gymnasium as gym
import matplotlib
import matplotlib.pyplot as plt
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import sb3_sap
from sb3_sap import DDPGAP, envs, plots, zoo
from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.cli.main import main, parser

matplotlib.use("agg")

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {path.name: path.read_text(encoding="utf-8") for path in PAGES}
LINKS = [(path, target) for path in PAGES for target in re.findall(r"\]\(((?!https?:)[^)#]+)", TEXTS[path.name])]


@pytest.mark.parametrize(("page", "target"), LINKS, ids=[f"{page.name}-{target}" for page, target in LINKS])
def test_links_lead_somewhere(page, target):
    assert (page.parent / target).exists()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_results(page):
    with_tables = runpy.run_path(str(ROOT / "docs" / "tables.py"))["with_tables"]
    assert TEXTS[page.name] == with_tables(page)


# ---------------------------------------------------------------- Python snippets

#: Those of a page run one after the other, as a reader would type them; trainings are cut to 300 steps.
SNIPPETS = {
    name: re.findall(r"^ *```python\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE) for name, text in TEXTS.items()
}
FAST = {"README.md"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in FAST else pytest.mark.slow)
        for name, snippets in SNIPPETS.items()
        if snippets
    ],
)
def test_snippets_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    for snippet in SNIPPETS[name]:
        code, cuts = re.subn(r"\.learn\([\d_]+", ".learn(300", textwrap.dedent(snippet))
        exec(compile(code.replace(", progress_bar=True", ""), name, "exec"), names)
        assert cuts == 0 or names["model"].num_timesteps == 300


def test_the_readme_has_its_three_snippets():
    assert len(SNIPPETS["README.md"]) == 3


@pytest.mark.slow
def test_the_readmes_own_problem_is_solved_as_it_says():
    names = {}
    exec(compile(SNIPPETS["README.md"][1], "README.md", "exec"), names)
    assert names["model"].num_timesteps == 1_000
    assert evaluate_policy(names["model"], Monitor(names["env"]), n_eval_episodes=5)[0] > 80


# ---------------------------------------------------------------- commands

#: What a command line of this package begins with, on a page; comments and other programs are left out.
COMMANDS = [
    (name, line.split("  #")[0].strip())
    for name, text in TEXTS.items()
    for language, block in re.findall(r"^ *```(.*?)\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    if language in ("", "bash")
    for line in block.replace("\\\n", "").splitlines()
    if line.strip().startswith("sb3-sap ")
]
#: Of other tests, or over the network, or of hours.
LONG = ("benchmark", "train", "enjoy", "optimize", "retest", "record-video", "plot", "torcs")


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[f"{page}-{command}" for page, command in COMMANDS])
def test_commands_are_understood(page, command):
    """Every flag of every printed command exists; RL Zoo's, which it reads itself, are run by test_zoo."""
    arguments = shlex.split(command)[1:]
    if arguments[0] in zoo.COMMANDS:
        return
    if "--help" in arguments:
        with pytest.raises(SystemExit, match="0"):
            parser().parse_args(arguments)
    else:
        parser().parse_args(arguments)  # exits with 2 where it does not understand


@pytest.mark.slow
def test_commands_run_as_printed(tmp_path, monkeypatch):
    """Those that need no network and no hours, in the order in which the pages print them."""
    monkeypatch.chdir(tmp_path)
    env = gym.make("sap/LaneKeeping-v0", laps=None)
    DDPGAP("MlpPolicy", env, seed=1).learn(300).save("wheel2")
    assert main(["demo", "--steps", "300", "--no-animation"]) == 0
    ran = []
    for _, command in dict.fromkeys(COMMANDS):
        arguments = shlex.split(command)[1:]
        uploads = arguments[0] == "push-to-hub" and "--dry-run" not in arguments
        if arguments[0] in LONG or uploads or "--help" in arguments or arguments[0] == "demo":
            continue
        assert main(arguments) == 0, command
        ran.append(arguments[0])
    assert {"evaluate", "push-to-hub"} <= set(ran)


# ---------------------------------------------------------------- nothing is left out


def test_every_public_name_is_in_the_reference():
    named = set(re.findall(r"auto(?:class|function|data):: (?:[\w.]*\.)?(\w+)", TEXTS["api.md"]))
    assert (set(sb3_sap.__all__) | set(envs.__all__) | set(plots.__all__)) - {"envs"} <= named


def test_every_parameter_is_told():
    told = set(re.findall(r"`(\w+)`", TEXTS["parameters.md"]))
    own = {name for cls in (DDPGAP, sb3_sap.DDPGAPCE2) for name in inspect.signature(cls).parameters}
    predictor = set(inspect.signature(sb3_sap.PermissibilityPredictor).parameters)
    assert own - set(inspect.signature(DDPG).parameters) <= told
    assert predictor - {"observation_space", "action_space"} <= told


def test_the_defaults_told_are_those_of_the_constructor():
    rows = re.findall(r"^\| `(\w+)` \| `?\"?([\d.,]+|random)\"?`? \|", TEXTS["parameters.md"], re.MULTILINE)
    assert len(rows) >= 14
    told = {name: text if text == "random" else float(text.replace(",", "")) for name, text in rows}
    # E's rate and batch size have the names of the algorithm's.
    constructors = (DDPGAP, sb3_sap.PermissibilityPredictor)
    defaults = {name: p.default for cls in constructors for name, p in inspect.signature(cls).parameters.items()}
    assert told == {name: defaults[name] for name in told}


def test_every_logged_metric_is_defined():
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "sb3_sap").glob("*.py"))
    logged = set(re.findall(r'record(?:_mean)?\("((?:sap|train)/\w+)"', source))
    assert len(logged) >= 10
    assert logged <= set(re.findall(r"`((?:sap|train)/\w+)`", TEXTS["method.md"]))


def test_every_algorithm_has_its_row():
    assert {cls.__name__ for cls in ALGORITHMS.values()} <= set(re.findall(r"`(\w+)`", TEXTS["can_i_use_it.md"]))


# ---------------------------------------------------------------- notebooks

#: The constants at the top of each notebook, cut to what shows that its cells run; 01 runs as it is.
NOTEBOOKS = {
    "01_action_permissibility": {},
    "02_lane_keeping": {"STEPS": 800, "TEST_TRACKS": ["g-track-3"]},
    "03_your_own_problem": {"STEPS": 1_200, "TRIALS": 2},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
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
