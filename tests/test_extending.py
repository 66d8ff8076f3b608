"""The extensions of CONTRIBUTING.md: each is made in a temporary copy of the repository, and used."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
CONFIGURATIONS = "sb3_sap/benchmark/groups.py"


@pytest.fixture
def copy(tmp_path):
    for folder in ("sb3_sap", "zoo_configs"):  # the former holds a link to the latter
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def edit(path, old, new):
    """Replaces a text that occurs once."""
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{path.name} has {text.count(old)} times {old!r}"
    path.write_text(text.replace(old, new), encoding="utf-8")


def use(copy, program):
    """Runs a program with the copy in place of the package."""
    environment = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
    code = f"import sb3_sap\nassert sb3_sap.__file__.startswith({str(copy)!r})\n" + textwrap.dedent(program)
    done = subprocess.run([sys.executable, "-c", code], cwd=copy, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_further_base_algorithm_takes_three_edits(copy):
    edit(
        copy / "sb3_sap" / "algorithms.py",
        "#: Every algorithm by its RL Zoo name",
        'class OtherAP(ActionPermissibilityMixin, TD3):\n    """A further base."""\n\n\n'
        "#: Every algorithm by its RL Zoo name",
    )
    edit(
        copy / "sb3_sap" / "algorithms.py", '    "td3_ap": TD3AP,\n', '    "td3_ap": TD3AP,\n    "other_ap": OtherAP,\n'
    )
    edit(copy / "sb3_sap" / "__init__.py", "    CrossQAP,\n)", "    CrossQAP,\n    OtherAP,\n)")
    (copy / "zoo_configs" / "other_ap.yml").write_text("default: {n_timesteps: 100, policy: MlpPolicy}\n", "utf-8")
    use(
        copy,
        """
        from sb3_sap.cli.main import main
        model = sb3_sap.OtherAP("MlpPolicy", "sap/LaneKeeping-v0", **sb3_sap.preset("default", sb3_sap.OtherAP))
        assert model.learn(50).num_timesteps == 50
        assert not main("train --algo other_ap --env sap/LaneKeeping-v0 -n 50 -f logs --eval-freq -1".split())
        """,
    )
    assert list((copy / "logs" / "other_ap").glob("*/*.zip"))


def test_further_task_takes_two_edits(copy):
    (copy / "sb3_sap" / "tasks" / "cart_pole.py").write_text(
        "def rises(obs, actions, next_obs):\n    return abs(next_obs[:, 2]) <= abs(obs[:, 2])\n", "utf-8"
    )
    with (copy / "zoo_configs" / "dqn_ap.yml").open("a", encoding="utf-8") as entries:
        entries.write(
            "\nCartPole-v1: {n_timesteps: 100, policy: MlpPolicy, ap_function: sb3_sap.tasks.cart_pole.rises}\n"
        )
    use(
        copy,
        """
        from sb3_sap.cli.main import main
        assert main("benchmark task CartPole-v1 --seeds 1 --out results".split()) == 0
        assert not main("train --algo dqn_ap --env CartPole-v1 -f logs --eval-freq -1".split())
        """,
    )
    page = (copy / "results" / "CartPole-v1" / "returns.md").read_text(encoding="utf-8")
    assert {"| dqn_ap:task ", "| dqn:task "} <= {line.partition("| 100 ")[0] for line in page.splitlines()}
    assert list((copy / "logs" / "dqn_ap").glob("*/*.zip"))


def test_further_benchmark_configuration_takes_one_edit(copy):
    configurations = ["linear", "ddpg_ap:default[alpha=0.25]"]
    edit(
        copy / CONFIGURATIONS,
        "GROUPS: dict[str, list[str]] = {\n",
        f"GROUPS: dict[str, list[str]] = {{\n    'mine': {configurations},\n",
    )
    use(
        copy,
        """
        from sb3_sap.cli.main import main
        grid = "--simulator highway --steps 100 --seeds 1 --tracks eroad --out results"
        assert main(f"benchmark summary --configurations mine {grid}".split()) == 0
        """,
    )
    page = (copy / "results" / "highway-100" / "summary.md").read_text(encoding="utf-8")
    assert [name for name in configurations if f"| {name} | 1 |" not in page] == []
