"""The rival with a safety critic: what it learns, and when it acts."""

import numpy as np
import pytest
import torch as th
from toy import Line, build, towards_centre

from sb3_sap.benchmark.recovery import SACRecovery

SETTINGS = {"ap_function": towards_centre, "learning_starts": 100, "batch_size": 32}


@pytest.mark.slow
def test_safety_critic_learns_which_actions_are_mistakes():
    model = build(SACRecovery, Line(labels=False), risk_gamma=0.0, **SETTINGS).learn(400)
    obs = th.tensor([[0.4, 0.5], [0.4, 0.5], [-0.4, 0.5], [-0.4, 0.5]])
    risk = th.sigmoid(model._risk(obs, th.tensor([[0.9], [-0.9], [0.9], [-0.9]])))
    assert (risk > 0.5).tolist() == [True, False, False, True]


def test_recovery_policy_takes_the_least_risky_candidate():
    model = build(SACRecovery, Line(labels=False), risk_threshold=0.5, **SETTINGS).learn(20)
    model._risk = lambda obs, actions: 20 * (actions[:, 0] - 0.2)  # a risk of 1/2 at 0.2
    assert model.guide(np.array([[0.1]], dtype=np.float32)) is None
    assert model.guide(np.array([[0.6]], dtype=np.float32)) < -0.8


def test_multiplier_rises_above_the_bound_and_falls_below_it():
    env = Line(labels=False)
    always = build(SACRecovery, env, **{**SETTINGS, "ap_function": lambda o, a, n: np.zeros(len(a), bool)}).learn(150)
    assert always.multiplier > 0.1
    never = build(SACRecovery, env, **{**SETTINGS, "ap_function": lambda o, a, n: np.ones(len(a), bool)}).learn(150)
    assert never.multiplier == 0.0
