"""README and docs agree with the package: links, tables, snippets, commands and names."""

import inspect
import json
import os
import re
import runpy
import shlex
import shutil
import textwrap
from pathlib import Path

import gymnasium as gym
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DDPG
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from toy import CONSTRAINED, nearby

import sb3_sap
from sb3_sap import DDPGAP, envs, plots, zoo
from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.cli.main import main, parser
from sb3_sap.envs.torcs.installation import TorcsNotFoundError
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS

matplotlib.use("agg")

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
FAMILIES = sorted((DOCS / "algorithms").glob("*.md"))
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(DOCS.glob("*.md")),
    *FAMILIES,
]


def name_of(page):
    """A page of the site by its path in docs, another one by its path in the repository."""
    return page.relative_to(DOCS if DOCS in page.parents else ROOT).as_posix()


TEXTS = {name_of(page): page.read_text(encoding="utf-8") for page in PAGES}
PAGE_IDS = list(TEXTS)
LINKS = [
    (page, target, anchor)
    for page in PAGES
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", TEXTS[name_of(page)])
]


def anchors(page):
    """The anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL), re.M
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(
    ("page", "target", "anchor"), LINKS, ids=[f"{name_of(page)}-{target}#{anchor}" for page, target, anchor in LINKS]
)
def test_links_have_targets(page, target, anchor):
    path = page.parent / target if target else page
    assert path.exists()
    assert not anchor or anchor in anchors(path)


@pytest.mark.parametrize("page", PAGES, ids=PAGE_IDS)
def test_tables_and_code_are_those_of_their_sources(page):
    filled = runpy.run_path(str(DOCS / "tables.py"))["filled"]
    assert TEXTS[name_of(page)] == filled(page)


def test_row_that_a_table_does_not_have_is_named(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- table: torcs-3000/headline.md rows: linear ddpg -->\n<!-- end -->\n", encoding="utf-8")
    with pytest.raises(ValueError, match="no row 'ddpg'"):
        runpy.run_path(str(DOCS / "tables.py"))["filled"](page)


# ---------------------------------------------------------------- the first screen

TAGLINE = "A Stable-Baselines3 extension that learns which actions are permissible while it learns to act."


@pytest.mark.parametrize("name", ["README.md", "setup.cfg", "CITATION.cff", "sb3_sap/__init__.py"])
def test_tagline_is_the_same_everywhere(name):
    assert TAGLINE in (ROOT / name).read_text(encoding="utf-8")


def test_site_begins_with_the_first_screen_of_the_readme():
    options = dict(re.findall(r'^:(start-after|end-before): "(.+)"$', TEXTS["index.md"], re.MULTILINE))
    after, before = options["start-after"], options["end-before"]
    assert [TEXTS["README.md"].count(text) for text in (after, before)] == [1, 1]
    screen = TEXTS["README.md"].partition(after)[2].partition(before)[0]
    assert TAGLINE in screen
    assert "def ap_function" in screen


def test_ap_function_of_the_first_screen_is_that_of_lane_keeping():
    names = {"np": np}
    exec(SNIPPETS["README.md"][0], names)
    obs, next_obs = np.random.default_rng(0).uniform(-1, 1, (2, 100, 5))
    labels = names["ap_function"](obs, None, next_obs)
    assert 20 < labels.sum() < 80
    np.testing.assert_array_equal(labels, envs.ap_function(obs, None, next_obs))


# ---------------------------------------------------------------- Python snippets

#: Those of a page run one after the other, as a reader would type them; trainings are cut to 300 steps.
SNIPPETS = {
    name: re.findall(r"^ *```python\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE) for name, text in TEXTS.items()
}
#: The scripts of the README; the other example has its own tests.
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py") if path.stem != "ddpg_ap_minimal")


def run_shortly(code, name, names, steps=300):
    """Runs code with its training cut short."""
    code, cuts = re.subn(r"\.learn\([\d_]+", f".learn({steps}", code)
    exec(compile(code.replace(", progress_bar=True", ""), name, "exec"), names)
    if cuts:  # what was begun is completed: a rollout, or the steps before an update
        model = names["model"]
        begun = model.train_freq.frequency if hasattr(model, "train_freq") else model.n_steps
        assert model.num_timesteps - steps in range(begun * model.n_envs)
    return cuts


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, snippets in SNIPPETS.items() if snippets])
def test_snippets_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"np": np} if name == "README.md" else {}  # whose first screen has a function alone
    try:
        for snippet in SNIPPETS[name]:
            run_shortly(textwrap.dedent(snippet), name, names)
    except TorcsNotFoundError as error:
        if os.environ.get("SB3_SAP_REQUIRE_TORCS"):
            raise
        pytest.skip(str(error))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_shortly(example.read_text(encoding="utf-8"), example.name, {}, steps=120) == 1


def test_readme_shows_every_example():
    assert len(EXAMPLES) >= 2
    assert SNIPPETS["README.md"][1:] == [path.read_text(encoding="utf-8") for path in EXAMPLES]
    assert "](examples/ddpg_ap_minimal.py)" in TEXTS["README.md"]


@pytest.mark.slow
def test_problem_of_the_readme_is_solved_as_it_says():
    names = runpy.run_path(str(ROOT / "examples" / "your_own_problem.py"))
    assert names["model"].num_timesteps == 1_000
    assert evaluate_policy(names["model"], Monitor(names["env"]), n_eval_episodes=5)[0] > 80


# ---------------------------------------------------------------- commands

#: The command lines of this package on each page, without comments.
COMMANDS = [
    (name, line.split("  #")[0].strip())
    for name, text in TEXTS.items()
    for language, block in re.findall(r"^ *```(.*?)\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    if language in ("", "bash")
    for line in block.replace("\\\n", "").splitlines()
    if line.strip().startswith("sb3-sap ")
]
#: Commands that other tests run, or that need the network or hours.
LONG = ("benchmark", "compare", "train", "enjoy", "optimize", "retest", "record-video", "plot", "torcs")


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[f"{page}-{command}" for page, command in COMMANDS])
def test_printed_commands_are_accepted(page, command):
    """Every flag of every printed command exists; tests/zoo runs those of RL Zoo, which reads them itself."""
    arguments = shlex.split(command)[1:]
    if arguments[0] in zoo.COMMANDS:
        return
    if "--help" in arguments:
        with pytest.raises(SystemExit, match="0"):
            parser().parse_args(arguments)
    else:
        parser().parse_args(arguments)  # exits with 2 if it refuses them


@pytest.mark.slow
def test_commands_run_as_printed(tmp_path, monkeypatch):
    """Commands that need neither the network nor hours, in the order of the pages."""
    monkeypatch.chdir(tmp_path)
    env = gym.make("sap/LaneKeeping-v0", laps=None)
    DDPGAP("MlpPolicy", env, seed=1).learn(300).save("wheel2")
    assert main(["demo", "--steps", "300", "--no-animation"]) == 0
    # The page on logs writes its log in Python, and prints the file of its columns.
    exec(SNIPPETS["logs.md"][0], {})
    shutil.copy("log.csv", "other.csv")
    (columns,) = re.findall(r"```yaml\n(.*?)```", TEXTS["logs.md"], re.DOTALL)
    Path("columns.yml").write_text(columns, encoding="utf-8")
    ran = []
    for _, command in dict.fromkeys(COMMANDS):
        arguments = shlex.split(command)[1:]
        uploads = arguments[0] == "push-to-hub" and "--dry-run" not in arguments
        if arguments[0] in LONG or uploads or "--help" in arguments or arguments[0] == "demo":
            continue
        assert main(arguments) == 0, command
        ran.append(arguments[0])
    assert {"evaluate", "predictor", "push-to-hub"} <= set(ran)


# ---------------------------------------------------------------- nothing is left out


def test_every_public_name_is_in_the_reference():
    reference = "".join(TEXTS[name_of(page)] for page in (DOCS / "api.md", *FAMILIES))
    named = re.findall(r"auto(?:class|function|data):: (?:[\w.]*\.)?(\w+)", reference)
    assert (set(sb3_sap.__all__) | set(envs.__all__) | set(plots.__all__)) - {"envs"} <= set(named)
    assert {cls.__name__ for cls in ALGORITHMS.values()} <= set(named)


def test_every_parameter_is_documented():
    documented = set(re.findall(r"`(\w+)`", TEXTS["parameters.md"]))
    own = {name for cls in (DDPGAP, sb3_sap.DDPGAPCE2) for name in inspect.signature(cls).parameters}
    predictor = set(inspect.signature(sb3_sap.PermissibilityPredictor).parameters)
    assert own - set(inspect.signature(DDPG).parameters) <= documented
    assert predictor - {"observation_space", "action_space"} <= documented


def test_documented_defaults_are_those_of_the_constructor():
    before, _, after = TEXTS["parameters.md"].partition("## On-policy algorithms")
    own, _, presets = after.partition("## Presets")
    # The predictor's learning rate and batch size have the names of the algorithm's.
    for text, least, constructors in (
        (before + presets, 14, (DDPGAP, sb3_sap.PermissibilityPredictor)),
        (own, 4, (sb3_sap.PPOAP,)),
    ):
        rows = re.findall(r"^\| `(\w+)` \| `?\"?([\d.,]+|random)\"?`? \|", text, re.MULTILINE)
        assert len(rows) >= least
        documented = {name: value if value == "random" else float(value.replace(",", "")) for name, value in rows}
        defaults = {name: p.default for cls in constructors for name, p in inspect.signature(cls).parameters.items()}
        assert documented == {name: defaults[name] for name in documented}


def test_every_logged_metric_is_defined():
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "sb3_sap").rglob("*.py"))
    logged = set(re.findall(r'record(?:_mean)?\("((?:sap|train)/\w+)"', source))
    assert len(logged) >= 10
    assert logged <= set(re.findall(r"`((?:sap|train)/\w+)`", TEXTS["method.md"]))


def test_every_algorithm_has_its_row_in_can_i_use_it():
    assert {cls.__name__ for cls in ALGORITHMS.values()} <= set(re.findall(r"`(\w+)`", TEXTS["can_i_use_it.md"]))


def test_documented_chain_of_mixins_is_that_of_the_class():
    [chain] = re.findall(r"```text\n(DDPGAP .*?)```", TEXTS["developer.md"], re.DOTALL)
    drawn = [line.split()[0] for line in chain.splitlines()]
    assert drawn == [cls.__name__ for cls in DDPGAP.__mro__ if cls.__module__ not in ("abc", "builtins")]


# ---------------------------------------------------------------- the pages of the algorithms

SPACES = {
    "Discrete": spaces.Discrete(3),
    "Box": spaces.Box(-1, 1, (2,), np.float32),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(3),
    "Dict": spaces.Dict({"x": spaces.Box(-1, 1, (2,), np.float32)}),
}


class Anything(gym.Env):
    """An environment with any spaces."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {"permissible": True}


def learns(cls, observation_space, action_space):
    """Whether an algorithm accepts these spaces."""
    policy = "MultiInputPolicy" if isinstance(observation_space, spaces.Dict) else "MlpPolicy"
    settings = {"constraint": nearby} if cls in CONSTRAINED else {}
    if cls in ON_POLICY_ALGORITHMS.values():
        settings |= {"n_steps": 8}
        policy = policy.replace("Policy", "LstmPolicy") if cls is sb3_sap.RecurrentPPOAP else policy
    else:
        settings |= {"buffer_size": 100}
    try:
        model = cls(policy, Anything(observation_space, action_space), device="cpu", **settings)
    except (AssertionError, ValueError):
        return False
    return model.learn(3).num_timesteps >= 3


@pytest.mark.parametrize("page", FAMILIES, ids=lambda page: page.stem)
def test_family_page_lists_the_spaces_that_its_algorithms_take(page):
    text = TEXTS[name_of(page)]
    rows = re.findall(r"^\| `(\w+)` \| ([✓✗]) \| ([✓✗]) \|$", text, re.MULTILINE)
    assert [name for name, _, _ in rows] == list(SPACES)
    for cls in (getattr(sb3_sap, name) for name in re.findall(r"autoclass:: (\w+)", text)):
        own = SPACES["Discrete" if getattr(cls, "discrete", False) else "Box"]
        takes = [(name, learns(cls, SPACES["Box"], space), learns(cls, space, own)) for name, space in SPACES.items()]
        assert takes == [(name, action == "✓", observation == "✓") for name, action, observation in rows], cls


@pytest.mark.parametrize("page", FAMILIES, ids=lambda page: page.stem)
def test_family_page_has_the_sections_of_the_pages_of_sb3(page):
    sections = re.findall(r"^## (.+)$", TEXTS[name_of(page)], re.MULTILINE)
    assert sections == ["Notes", "Can I use?", "Example", "Results", "Parameters"]
    assert f"algorithms/{page.stem}\n" in TEXTS["index.md"]


def test_every_algorithm_is_on_one_page():
    named = [name for page in FAMILIES for name in re.findall(r"autoclass:: (\w+)", TEXTS[name_of(page)])]
    known = [*ALGORITHMS.values(), *ON_POLICY_ALGORITHMS.values()]
    assert sorted(named) == sorted(cls.__name__ for cls in known)


# ---------------------------------------------------------------- notebooks

#: Constants at the top of each notebook, reduced so that its cells run shortly; 01 runs unchanged.
NOTEBOOKS = {
    "01_action_permissibility": {},
    "02_lane_keeping": {"STEPS": 800, "TEST_TRACKS": ["g-track-3"]},
    "03_your_own_problem": {"STEPS": 1_200, "TRIALS": 2},
    "04_logs": {"LOGGED": 1_000, "STEPS": 160, "TRACKS": ["g-track-3"]},
    "05_ppo_and_masks": {"STEPS": 512, "LANE_STEPS": 768},
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
