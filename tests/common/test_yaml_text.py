"""Numbers as people write them in YAML, on the command line and in files."""

import pytest

from sb3_sap.benchmark.configurations import parse_configuration
from sb3_sap.common.yaml_text import read_yaml


@pytest.mark.parametrize(
    ("text", "value"), [("1e-3", 0.001), ("5E-06", 5e-6), ("-2e3", -2000.0), ("1.e+2", 100.0), ("1.5", 1.5), ("3", 3)]
)
def test_numbers(text, value):
    assert read_yaml(text) == value
    assert type(read_yaml(f"[{text}]")[0]) is type(value)


@pytest.mark.parametrize("text", ["lin_1e-3", "1e", "e-3", "a1e-3", "1e-3x"])
def test_words_stay_words(text):
    assert read_yaml(text) == text


@pytest.mark.parametrize("written", ["5e-6", "0.000005", "5E-06"])
def test_a_small_setting_of_a_configuration_is_a_number(written):
    configuration = parse_configuration(f"ddpg_ap:paper[predictor_kwargs.weight_decay={written}]")
    assert configuration.changes == {"predictor_kwargs.weight_decay": 5e-6}
    assert parse_configuration(configuration.name) == configuration
