"""The rival with a safety critic: what it learns, and when it acts."""

import inspect

import numpy as np
import pytest
import torch as th
from toy import Line, build, towards_centre

from sb3_sap.benchmark.learners import CLASSES, algorithm_class
from sb3_sap.benchmark.recovery import SACRecovery

SETTINGS = {"ap_function": towards_centre, "learning_starts": 100, "batch_size": 32}


@pytest.mark.slow
def test_safety_critic_learns_which_actions_are_mistakes():
    model = build(SACRecovery, Line(labels=False), critic_discount=0.0, **SETTINGS).learn(400)
    obs = th.tensor([[0.4, 0.5], [0.4, 0.5], [-0.4, 0.5], [-0.4, 0.5]])
    risk = th.sigmoid(model._critic_risk(obs, th.tensor([[0.9], [-0.9], [0.9], [-0.9]])))
    assert (risk > 0.5).tolist() == [True, False, False, True]


@pytest.mark.parametrize("threshold", [0.2, 0.5, 0.8])
def test_recovery_policy_takes_the_least_risky_candidate(threshold):
    model = build(SACRecovery, Line(labels=False), recovery_threshold=threshold, **SETTINGS).learn(20)
    model._critic_risk = lambda obs, actions: th.logit((actions[:, 0] + 1) / 2)  # a risk of 0 at -1, of 1 at 1
    assert model.guide(np.array([[2 * threshold - 1.1]], dtype=np.float32)) is None
    assert model.guide(np.array([[2 * threshold - 0.9]], dtype=np.float32)) < -0.8


def test_multiplier_rises_above_the_bound_and_falls_below_it():
    env = Line(labels=False)
    always = build(SACRecovery, env, **{**SETTINGS, "ap_function": lambda o, a, n: np.zeros(len(a), bool)}).learn(150)
    assert always.multiplier > 0.1
    never = build(SACRecovery, env, **{**SETTINGS, "ap_function": lambda o, a, n: np.ones(len(a), bool)}).learn(150)
    assert never.multiplier == 0.0


@pytest.mark.parametrize("algo", [name for name, path in CLASSES.items() if path.startswith("sb3_sap.benchmark")])
def test_variants_of_the_benchmark_take_no_parameter_away_from_their_algorithm(algo):
    variants = [each for each in algorithm_class(algo).__mro__ if each.__module__.startswith("sb3_sap.benchmark")]
    own = {
        name for each in variants if "__init__" in vars(each) for name in inspect.signature(each.__init__).parameters
    }
    parent = next(each for each in algorithm_class(algo).__mro__ if each not in variants)
    assert (own - {"self", "args", "kwargs"}).isdisjoint(inspect.signature(parent).parameters)
