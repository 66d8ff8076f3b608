"""Presets are read from zoo_configs; those of the paper have the values of its section 5.1."""

from importlib import resources

import gymnasium as gym
import pytest
from stable_baselines3 import SAC
from toy import DISCRETE

from sb3_sap import DDPGAP, SACAP, TQCAP
from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.benchmark.learners import CLASSES
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.presets import algorithms, load_config, preset, preset_names

PAPER = {
    "gamma": 0.9,
    "tau": 0.001,
    "learning_rate": 0.001,
    "actor_learning_rate": 0.0001,
    "batch_size": 128,
    "buffer_size": 100_000,
    "policy_kwargs": {"net_arch": [128, 256]},
}
PAPER_GUIDANCE = {
    "alpha": 0.9,
    "n_candidates": 128,
    "knowledge_buffer_size": 10_000,
    "validation_fraction": 0.1,
    "dataset_size": 2_000,
    "validation_size": 200,
}


@pytest.mark.parametrize("algo", ["ddpg", "ddpg_ce1", "ddpg_ce2", "ddpg_ap", "ddpg_ap_ce2"])
def test_paper_preset_has_the_values_of_the_paper(algo):
    found = preset("paper", algo)
    expected = PAPER | (PAPER_GUIDANCE if "ap" in algo else {})
    assert {key: found[key] for key in expected} == expected
    assert found["action_noise"]["theta"] == 0.6
    assert found["action_noise"]["sigma"] == 0.3
    assert ("predictor_kwargs" in found) == ("ap" in algo)


def test_paper_preset_has_the_predictor_of_the_paper():
    predictor = preset("paper")["predictor_kwargs"]
    assert predictor == {
        "net_arch": [128, 256],
        "optimizer_class": "SGD",
        "learning_rate": 0.01,
        "weight_decay": 0.01,
        "batch_size": 128,
    }


def test_t_k_follows_the_length_of_the_run():
    assert preset("paper")["t_k"] == 500
    assert preset("paper", steps=15_000)["t_k"] == 500
    assert preset("paper", steps=3_000)["t_k"] == 150


def test_other_reading_differs_in_how_e_is_fitted_alone():
    for steps in (3_000, 15_000):
        literal, adam = preset("paper", steps=steps), preset("paper_adam", steps=steps)
        fitted = literal.pop("predictor_kwargs"), adam.pop("predictor_kwargs")
        assert literal == adam
        assert fitted[1] == {**fitted[0], "optimizer_class": "Adam", "learning_rate": 0.001, "weight_decay": 0}


def test_paper_preset_is_applied_to_a_model():
    env = gym.make("sap/LaneKeeping-v0")
    model = DDPGAP("MlpPolicy", env, **preset("paper"))
    assert model.predictor.optimizer.param_groups[0]["weight_decay"] == 0.01
    assert (model.t_k, model.gamma, model.actor.optimizer.param_groups[0]["lr"]) == (500, 0.9, 0.001)
    model.learn(3)  # the first update sets the actor's own rate
    assert model.actor.optimizer.param_groups[0]["lr"] == 0.0001
    assert model.critic.optimizer.param_groups[0]["lr"] == 0.001


@pytest.mark.parametrize(("algo", "cls"), [*ALGORITHMS.items(), *ON_POLICY_ALGORITHMS.items()])
def test_preset_of_a_class_is_that_of_its_name(algo, cls):
    derived = type("Mine", (cls,), {})
    for name in preset_names(algo):
        assert preset(name, cls) == preset(name, derived) == preset(name, algo)
    assert preset_names(derived) == preset_names(algo)


def test_fast_preset_differs_between_algorithms():
    assert preset("fast", TQCAP)["gamma"] == 0.8
    assert preset("fast", SACAP)["gamma"] == 0.9
    assert TQCAP("MlpPolicy", gym.make("sap/LaneKeeping-v0"), **preset("fast", TQCAP)).gamma == 0.8


def test_every_algorithm_has_an_installed_configuration():
    assert {*ALGORITHMS, *ON_POLICY_ALGORITHMS} <= set(algorithms()) <= {*CLASSES, *ON_POLICY_ALGORITHMS}
    for algo in ALGORITHMS:
        assert ("paper" in preset_names(algo)) == algo.startswith("ddpg")
        steering = {"sap/LaneKeeping-v0", "sap/TorcsLaneKeeping-v0"}
        assert {"default"} | (set() if ALGORITHMS[algo] in DISCRETE else steering) <= load_config(algo).keys()
    assert (resources.files("sb3_sap") / "zoo_configs" / "ddpg_ap.yml").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("papper",), "did you mean 'paper'"),
        (("paper", "ddpg_pa"), "did you mean 'ddpg_ap'"),
        (("x", "ddpg_ap"), "one of 'paper', 'paper_adam', 'default'"),
        (("fats",), "did you mean 'fast'"),
        (("fast",), r"preset\('fast', TQCAP\) or preset\('fast', 'tqc_ap'\)"),
        (("default",), "differs from algorithm to algorithm"),
        (("paper", TQCAP), "`name` = 'paper' is unknown: choose one of 'default', 'penalty', 'loss', 'fast'"),
        (("fast", SAC), "`algo` = SAC is neither an algorithm of sb3_sap nor derived from one.*'tqc_ap'"),
        (("fast", dict), "`algo` = dict is neither"),
    ],
)
def test_unknown_presets_and_algorithms_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        preset(*arguments)
