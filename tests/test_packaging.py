"""The wheel that is built from the sdist works with its declared requirements alone; a release changes the version."""

import configparser
import os
import re
import shutil
import subprocess
import sys
import textwrap
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import sb3_sap

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
LEFT_OUT = shutil.ignore_patterns(".*", "*.egg-info", "__pycache__", "build", "dist", "results", "_build")
#: What a user of each extra imports or runs.
PROGRAMS = {
    "": """
        import gymnasium as gym
        from sb3_sap.presets import algorithms, preset

        env = gym.make("sap/LaneKeeping-v0", track="eroad")
        sb3_sap.DDPGAP("MlpPolicy", env, **preset("fast", sb3_sap.DDPGAP)).learn(120, progress_bar=True)
        assert all(isinstance(preset("default", algo), dict) for algo in algorithms())
        assert main(["benchmark", "report"]) == 1  # a sentence says which extra is needed
    """,
    "benchmark": """
        grid = ["--simulator", "highway", "--configurations", "linear", "--tracks", "eroad", "--out", "."]
        assert main(["benchmark", "summary", *grid]) == 0
    """,
    "dask": "import distributed, sb3_sap.benchmark.dispatch",
    "docs": "import furo, myst_parser, sphinx.application",
    "hub": "import huggingface_sb3, sb3_sap.cli.hub",
    "minigrid": """
        import gymnasium as gym

        env = gym.make("sap/MiniGrid-v0")
        env.reset(seed=0)
        assert "permissible" in env.step(0)[4]
    """,
    "robotics": """
        from sb3_sap.evaluation import make_env

        assert set(make_env("FetchReach-v4").reset(seed=0)[0]) == {"observation", "achieved_goal", "desired_goal"}
    """,
    "tensorboard": """
        sb3_sap.DDPG("MlpPolicy", "Pendulum-v1", tensorboard_log="boards").learn(10)
        import tensorboard.program
    """,
    "postgres": "import psycopg, sb3_sap.zoo.storages, sb3_sap.zoo.tuning",
    "zoo": 'main(["train", "--algo", "ddpg_ap", "--env", "sap/LaneKeeping-v0", "-n", "50", "-f", "logs"])',
}
#: The beginning of each program: what is not declared cannot be imported, as if it were not installed.
ALONE = """
    import sys

    class Without:
        def __init__(self, finder):
            self.finder = finder

        def __getattr__(self, name):
            return getattr(self.finder, name)

        def find_spec(self, name, *rest):
            return None if name.partition(".")[0] in {absent} else self.finder.find_spec(name, *rest)

    sys.meta_path[:] = map(Without, sys.meta_path)
    import sb3_sap
    from sb3_sap.cli.main import main
    assert sb3_sap.__file__.startswith({site!r}), sb3_sap.__file__
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder into which the wheel, and nothing else, is installed."""
    folder = tmp_path_factory.mktemp("published")
    shutil.copytree(ROOT, folder / "source", ignore=LEFT_OUT)
    run("-m", "build", "--outdir", folder, folder / "source")  # the sdist, and from it the wheel
    [wheel] = folder.glob("*.whl")
    run("-m", "pip", "install", "-q", "--no-deps", "--target", folder / "site", wheel)
    return folder / "site"


def run(*arguments, **options):
    done = subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stderr


def normal(name):
    return re.sub("[-_.]+", "-", name).lower()


def brought_by(distribution, extra):
    """The names of all distributions that are installed with one of them and one of its extras."""
    found, wanted = set(), [(distribution, extra)]
    while wanted:
        distribution, extra = wanted.pop()
        if (normal(distribution.name), extra) in found:
            continue
        found.add((normal(distribution.name), extra))
        for needed in map(Requirement, distribution.requires or []):
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                [installed] = metadata.distributions(name=needed.name)
                wanted += [(installed, one) for one in needed.extras or {""}]
    return {name for name, _ in found}


def declared():
    """Every requirement of setup.cfg, of the core and of the extras."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    texts = [setup["options"]["install_requires"], *setup["options.extras_require"].values()]
    return {Requirement(line) for text in texts for line in text.splitlines() if line}


def lower_bound(requirement):
    return max((Version(one.version) for one in requirement.specifier if one.operator == ">="), default=None)


def test_every_requirement_has_a_lower_bound():
    assert len(declared()) > 30
    assert [str(one) for one in declared() if lower_bound(one) is None] == []


def test_lower_bound_of_torch_is_not_below_that_of_sb3():
    [ours] = [one for one in declared() if one.name == "torch"]
    [theirs] = [one for one in map(Requirement, metadata.requires("stable-baselines3")) if one.name == "torch"]
    assert lower_bound(ours) >= lower_bound(theirs)


def test_every_file_of_the_package_is_in_the_wheel(site):
    [wheel] = site.parent.glob("*.whl")
    folders = ROOT / "sb3_sap", ROOT / "sb3_sap" / "zoo_configs"  # the latter is a link, which rglob does not follow
    files = {path for folder in folders for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"}
    wanted = {path.relative_to(ROOT).as_posix() for path in files}
    assert {"sb3_sap/zoo_configs/ddpg_ap.yml", "sb3_sap/py.typed"} <= wanted
    assert wanted <= set(zipfile.ZipFile(wheel).namelist())


@pytest.mark.parametrize("extra", PROGRAMS)
def test_package_works_with_each_extra_alone(site, extra, tmp_path):
    [published] = metadata.distributions(name="sb3-sap", path=[str(site)])
    declared = brought_by(published, extra)
    owners = metadata.packages_distributions()
    absent = {module for module, names in owners.items() if not declared & set(map(normal, names))}
    assert {"mypy", "pytest"} <= absent
    program = textwrap.dedent(ALONE).format(absent=absent, site=str(site)) + textwrap.dedent(PROGRAMS[extra])
    run("-c", program, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(site)})


# ---------------------------------------------------------------- releases


@pytest.fixture(scope="module")
def repository(tmp_path_factory):
    """A repository with a section for the release 0.2.0, which tests may clone."""
    folder = tmp_path_factory.mktemp("repository")
    kept = shutil.ignore_patterns(".git", ".venv*", "*.egg-info", "__pycache__", "build", "dist", "results", "_build")
    shutil.copytree(ROOT, folder, ignore=kept, symlinks=True, dirs_exist_ok=True)
    changelog = folder / "CHANGELOG.md"
    text = changelog.read_text(encoding="utf-8")
    assert text.count("## [Unreleased]\n") == 1
    changelog.write_text(text.replace("[Unreleased]", "[0.2.0] - 2026-01-31"), encoding="utf-8")
    git(folder, "init", "-q")
    for name, value in (("user.name", "somebody"), ("user.email", "somebody@example.org")):
        git(folder, "config", name, value)
    commit(folder)
    return folder


@pytest.fixture
def clone(repository, tmp_path):
    shutil.copytree(repository, tmp_path / "clone", symlinks=True)
    return tmp_path / "clone"


def git(folder, *arguments):
    return subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def commit(folder):
    git(folder, "add", "--all")
    git(folder, "commit", "-q", "-m", "a change")


def release(folder, version):
    command = [sys.executable, str(folder / ".ci" / "release.py"), version]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def append(path, text):
    path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")


def test_release_changes_the_version_builds_and_tags(clone):
    before = git(clone, "rev-parse", "HEAD")
    done = release(clone, "0.2.0")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (clone / "dist").iterdir()} == {
        "sb3_sap-0.2.0-py3-none-any.whl",
        "sb3_sap-0.2.0.tar.gz",
    }
    assert git(clone, "rev-parse", "HEAD~1") == before
    changed = git(clone, "show", "v0.2.0^{commit}", "--format=", "--unified=0").splitlines()
    lines = [line for line in changed if re.match(r"[+-](?![+-])", line)]
    assert lines == [f'-__version__ = "{sb3_sap.__version__}"', '+__version__ = "0.2.0"']
    assert git(clone, "status", "--porcelain") == ""
    assert "### Added" in git(clone, "tag", "--list", "--format=%(contents)", "v0.2.0")


def test_failing_release_changes_nothing(clone):
    setup = clone / "setup.cfg"
    text = setup.read_text(encoding="utf-8")
    assert text.count("attr: sb3_sap.__version__") == 1
    setup.write_text(text.replace("attr: sb3_sap.__version__", "0.1.9"), encoding="utf-8")
    commit(clone)
    before = git(clone, "rev-parse", "HEAD")
    assert release(clone, "0.2.0").returncode != 0
    assert git(clone, "rev-parse", "HEAD") == before
    assert git(clone, "tag", "--list") == git(clone, "status", "--porcelain") == ""


@pytest.mark.parametrize(
    ("version", "change", "sentence"),
    [
        ("0.2", lambda clone: None, "three numbers such as 1.2.3, but is '0.2'"),
        ("0.0.1", lambda clone: None, "0.0.1 is older than the current version"),
        ("0.3.0", lambda clone: None, "no section '## [0.3.0] - YYYY-MM-DD' with entries"),
        ("0.2.0", lambda clone: append(clone / "README.md", "more"), "uncommitted changes"),
        ("0.2.0", lambda clone: git(clone, "tag", "v0.2.0"), "The tag v0.2.0 exists already"),
    ],
)
def test_release_that_cannot_be_made_is_refused(clone, version, change, sentence):
    change(clone)
    before = git(clone, "rev-parse", "HEAD"), git(clone, "status", "--porcelain"), git(clone, "tag", "--list")
    done = release(clone, version)
    assert done.returncode == 1
    assert sentence in done.stderr
    assert before == (git(clone, "rev-parse", "HEAD"), git(clone, "status", "--porcelain"), git(clone, "tag", "--list"))
    assert not (clone / "dist").exists()


def test_section_without_entries_does_not_count(clone):
    text = (clone / "CHANGELOG.md").read_text(encoding="utf-8")
    (clone / "CHANGELOG.md").write_text(
        text.replace("0.2.0", "0.1.0") + "\n## [0.2.0] - 2026-01-31\n", encoding="utf-8"
    )
    commit(clone)
    assert "no section" in release(clone, "0.2.0").stderr
