"""Mistakes in the settings of on-policy models are refused in one sentence."""

import inspect

import numpy as np
import pytest
import stable_baselines3
from gymnasium import spaces
from rollouts import BASES, Recorder, build_on_policy
from toy import Line

from sb3_sap import A2CAP, PPOAP, TRPOAP, OnPolicyPermissibilityMixin, preset
from sb3_sap.presets import preset_names


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"alpha": 0.5}, "^`alpha` is 1 .* or 0 .* but is 0.5"),
        ({"n_candidates": 0}, "^`n_candidates` must be a whole number of at least 1"),
        ({"permissibility_coef": -1.0}, "^`permissibility_coef` must be at least 0"),
        ({"permissibility_coef": "high"}, "^`permissibility_coef` must be a number, a schedule"),
        ({"predictor_epochs": -1}, "^`predictor_epochs` must be a number of at least 0"),
        ({"min_per_class": 0}, "^`min_per_class` must be a whole number of at least 1"),
        ({"penalty": "much"}, '^`penalty` must be a number of at least 0, "auto"'),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_setting_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        build_on_policy(PPOAP, **settings)


def test_the_loss_is_refused_where_it_has_no_place():
    with pytest.raises(ValueError, match=r"^`permissibility_coef` = 1\.0 cannot be used by TRPOAP"):
        build_on_policy(TRPOAP, permissibility_coef=1.0)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.MultiBinary((2, 2)), "one-dimensional MultiDiscrete or MultiBinary"),
        (spaces.MultiDiscrete([2, 2], start=[0, 1]), "actions that count from 0"),
        (spaces.Discrete(2, start=1), "actions that count from 0"),
        (spaces.Box(-np.inf, np.inf, (1,)), "actions are bounded"),
    ],
    ids=str,
)
def test_action_space_is_refused(space, message):
    with pytest.raises(ValueError, match=f"^PPOAP .*{message}"):
        build_on_policy(PPOAP, Recorder(space))


def test_as_many_combinations_as_are_allowed_are_judged():
    model = build_on_policy(PPOAP, Recorder(spaces.MultiBinary(12)))
    assert len(model._guide(predicts=True).actions) == 4096


def test_missing_label_is_an_error():
    with pytest.raises(ValueError, match=r"^There is no AP function"):
        build_on_policy(PPOAP, Line(labels=False), ap_function=None).learn(16)


def test_off_policy_algorithm_is_refused():
    with pytest.raises(TypeError, match=r"^Mine puts OnPolicyPermissibilityMixin before an off-policy algorithm"):
        type("Mine", (OnPolicyPermissibilityMixin, stable_baselines3.SAC), {})


@pytest.mark.parametrize("name", ["default", "penalty", "loss"])
def test_model_is_built_from_each_preset(name):
    assert preset_names(PPOAP) == ["default", "penalty", "loss"]
    model = PPOAP("MlpPolicy", Line(), **preset(name, PPOAP))
    assert model.penalty == ("auto_0.25" if name == "penalty" else 0.0)


def test_schedules_may_be_written_as_in_yaml():
    model = build_on_policy(PPOAP, learning_rate="lin_0.01", clip_range="lin_0.2", permissibility_coef="lin_1.0_0.5")
    assert model.lr_schedule(0.5) == 0.005
    assert model.clip_range(0.5) == 0.1
    assert model.permissibility_coef(0.5) == 0.0
    assert "clip_range" not in inspect.signature(A2CAP).parameters


@pytest.mark.parametrize("algorithm", BASES)
def test_signature_lists_every_parameter(algorithm):
    parameters = inspect.signature(algorithm).parameters
    assert {"n_steps", "alpha", "penalty", "permissibility_coef", "knowledge_buffer_size"} <= parameters.keys()
