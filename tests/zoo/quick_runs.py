"""Settings of runs that take seconds; importing this module skips a test module if RL Zoo is not installed."""

import pytest

MISSING = "RL Zoo is not installed: pip install sb3-sap[zoo]"
optuna = pytest.importorskip("optuna", reason=MISSING)
rl_zoo3 = pytest.importorskip("rl_zoo3", reason=MISSING)

from sb3_sap.cli.main import main  # noqa: E402
from sb3_sap.zoo.registration import register  # noqa: E402

ENV = "sap/LaneKeeping-v0"
FOLDER = "sap-LaneKeeping-v0"
#: Small networks, and fits of E from the first steps on.
QUICK = [
    "policy_kwargs:dict(net_arch=[8])",
    "predictor_kwargs:dict(net_arch=[8])",
    "batch_size:8",
    "buffer_size:500",
    "dataset_size:16",
    "min_per_class:1",
    "n_candidates:8",
    "validation_size:8",
]

register()


def optimize(*flags):
    command = ["optimize", "--env", ENV, "-n", "60", "--eval-episodes", "1", "--guidance-only", "--study-name", "study"]
    return main([*command, *flags, "-params", *QUICK])
