"""The table of retested settings."""

import pandas as pd
import pytest
from quick_runs import ENV, optuna

from sb3_sap.cli.main import main
from sb3_sap.zoo.retest import summary


@pytest.mark.parametrize(
    ("seeds", "entries", "sentence"),
    [
        ({"default": 1, "trial 0": 1}, ["| 0.5 |  |", "| 0.75 | +0.25 |"], "One seed: no interval."),
        ({"default": 2, "trial 0": 1}, ["| 0.5 [0.5, 0.5] |", "| +0.25 |"], "Where there is one seed: no interval."),
        ({"default": 2, "trial 0": 2}, ["| 0.75 [0.75, 0.75] | +0.25 [+0.25, +0.25] |"], "95 %"),
    ],
)
def test_table_has_no_interval_for_a_single_seed(seeds, entries, sentence):
    study = optuna.create_study(study_name="study")
    study.tell(study.ask(), 0.9)
    scores = {"default": 0.5, "trial 0": 0.75}
    rows = [
        {"arm": arm, "seed": seed, "task": "t", "score": scores[arm]} for arm in seeds for seed in range(seeds[arm])
    ]
    text = summary(pd.DataFrame(rows), study, ["t"], "sb3-sap retest")
    assert sentence in text
    for entry in entries:
        assert entry in text


def test_retest_refuses_several_jobs(capsys):
    command = ["retest", "--env", ENV, "-n", "10", "--n-jobs", "2", "--storage", "study.log", "--study-name", "study"]
    assert main(command) == 1
    assert "trains one model after the other: leave `--n-jobs` out" in capsys.readouterr().err
