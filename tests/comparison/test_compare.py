"""``compare`` and its command, with real processes."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from toy import Line, towards_centre

from sb3_sap import compare

pytestmark = pytest.mark.slow
QUICK = {"learning_starts": 20, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}


def test_comparison_of_a_class_of_the_user(tmp_path):
    console = Console(record=True, quiet=True)
    result = compare(
        Line,
        towards_centre,
        steps=60,
        seeds=2,
        episodes=1,
        settings=QUICK,
        env_kwargs={"labels": False},
        out=tmp_path,
        console=console,
    )
    assert sorted(result.evaluations["way"].unique()) == ["base", "guidance", "loss", "penalty"]
    assert len(result.evaluations) == 4 * 2 * 10
    assert (tmp_path / "curves.png").stat().st_size > 1000
    assert "Use " in result.decision


def test_run_that_fails_is_named_and_stops_the_others(tmp_path):
    def broken(obs, actions, next_obs):
        # The first run fails; the others would go on for minutes.
        if (tmp_path / "failed").exists():
            return np.ones(len(actions), dtype=bool)
        (tmp_path / "failed").touch()
        raise KeyError("speed")

    with pytest.raises(
        ValueError, match=r"^The run '\w+' with seed 0 failed: RuntimeError: `ap_function` broken raised"
    ):
        compare(Line, broken, steps=100_000, seeds=2, settings={**QUICK, "learning_starts": 99_000}, out=tmp_path)
    assert (tmp_path / "evaluations.csv").exists()


def test_command_prints_decision_and_lines(tmp_path):
    command = [sys.executable, "-m", "sb3_sap.cli.main", "compare", "MountainCar-v0", "--seeds", "2", "--steps", "300"]
    command += ["--ap-function", "sb3_sap.tasks.mountain_car", "--episodes", "1", "--out", str(tmp_path / "out")]
    run = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert "Use base: DQN alone, without the label." in run.stdout
    assert "from stable_baselines3 import DQN" in run.stdout
    assert (tmp_path / "out" / "train.py").exists()
    assert Path(tmp_path / "out" / "decision.txt").read_text().startswith("Use ")
