"""The permissibility loss within the base's own updates: its gradient, its scale, and what it leaves alone."""

import copy

import pytest
import torch as th
from stable_baselines3.common.utils import set_random_seed
from torch.nn import functional as F
from toy import DISCRETE, GUIDED, build

from sb3_sap import DDPGAP, DQNAP, SACAP, TD3AP, CrossQAP

SETTINGS = {"alpha": 0.0, "permissibility_coef": 1.0}


def weights(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def same(one, other):
    return all(th.equal(value, other[name]) for name, value in one.items())


def test_gradient_is_the_base_gradient_plus_that_of_the_scaled_loss():
    model = build(DDPGAP, **SETTINGS, learning_rate=0.1).learn(40)
    model.actor.optimizer = th.optim.SGD(model.actor.parameters(), lr=0.1)
    model.permissibility_coef, model.validation_accuracy = 2.0, 1.0
    parameters = list(model.actor.parameters())
    alone = copy.deepcopy(model.actor.state_dict())
    model.q_spread, model._n_updates = 3.0, 0  # no measurement is due at the first update
    set_random_seed(0)
    observations = model.replay_buffer.sample(8).observations  # of the base
    shown = model.replay_buffer.sample(model.predictor.batch_size).observations  # of the loss
    # The critic of a deep copy takes its step before the actor does.
    twin = copy.deepcopy(model)
    twin.actor.optimizer = th.optim.SGD(twin.actor.parameters(), lr=0.0)
    set_random_seed(0)
    twin.permissibility_coef = 0.0
    twin._setup_learn(8)
    set_random_seed(0)
    twin.train(1, 8)
    own = -twin.critic.q1_forward(observations, model.actor(observations)).mean()
    added = 2.0 * 3.0 * F.softplus(-model.predictor(shown, model.actor(shown))).mean()
    gradients = th.autograd.grad(own + added, parameters)
    model._setup_learn(8)
    set_random_seed(0)
    model.train(1, 8)
    for (name, parameter), gradient in zip(model.actor.named_parameters(), gradients, strict=True):
        th.testing.assert_close(parameter, alone[name] - 0.1 * gradient, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("algorithm", [DDPGAP, DQNAP])
def test_coefficient_of_zero_changes_no_bit(algorithm):
    plain, zero = build(algorithm).learn(80), build(algorithm, permissibility_coef=lambda _: 0.0).learn(80)
    assert same(weights(plain), weights(zero))


@pytest.mark.parametrize("algorithm", [*GUIDED, *DISCRETE])
def test_loss_is_learned_from_and_leaves_no_hook(monkeypatch, algorithm):
    monkeypatch.setattr(algorithm, "predictor_accurate", True)
    plain = build(algorithm, alpha=0.0).learn(60)
    model = build(algorithm, **SETTINGS).learn(60)
    assert not same(weights(plain), weights(model))
    optimizer = model.policy.optimizer if algorithm in DISCRETE else model.actor.optimizer
    assert not optimizer._optimizer_step_pre_hooks
    if algorithm not in DISCRETE:
        assert model.q_spread > 0


def test_modes_and_running_statistics_of_the_networks_are_restored():
    model = build(CrossQAP, **SETTINGS).learn(60)
    model.policy.set_training_mode(True)
    model.critic.set_training_mode(False)
    buffers = {key: value.clone() for key, value in model.policy.named_buffers()}
    before = {key: module.training for key, module in model.policy.named_modules()}
    model.actor.optimizer.zero_grad()
    model._add_gradient(model.actor.optimizer)
    assert {key: module.training for key, module in model.policy.named_modules()} == before
    assert all(th.equal(value, buffers[key]) for key, value in model.policy.named_buffers())


def test_scale_of_the_loss_is_the_spread_of_q_over_actions(monkeypatch):
    model = build(SACAP).learn(40)
    observations = model.replay_buffer.sample(model.predictor.batch_size).observations
    for factor in (6.0, 6000.0):

        def linear(model, obs, actions, factor=factor):
            return 500 + factor * actions[:, 0]

        # A constant in Q, as a constant in the reward brings it, changes nothing.
        monkeypatch.setattr("sb3_sap.guidance.permissibility_loss.q_values", linear)
        model.q_spread = 0.0
        model._measure_spread(observations)
        assert model.q_spread == pytest.approx(factor / 3**0.5, rel=0.2)  # of a uniform variable from -1 to 1


def test_linear_coefficient_ends_at_zero():
    model = build(TD3AP, alpha=0.0, permissibility_coef="lin_1.0")
    coefs = []
    model.learn(60, callback=lambda *_: coefs.append(model._current_coef) or True)
    assert coefs[0] > 0.9
    assert coefs[-1] == pytest.approx(0.0, abs=0.02)


def test_coefficient_may_fade_earlier():
    model = build(TD3AP, alpha=0.0, permissibility_coef="lin_2.0_0.5")
    coefs = [model.permissibility_coef(remaining) for remaining in (1.0, 0.75, 0.5, 0.0)]
    assert coefs == pytest.approx([2.0, 1.0, 0.0, 0.0])


def test_predictor_is_fitted_rarely_once_nothing_learns_from_it():
    model = build(SACAP, alpha=0.0, permissibility_coef="lin_1.0_0.5")
    model._current_progress_remaining = 0.6
    assert model.refits_due(100, 110) == 10
    model._current_progress_remaining = 0.4
    assert model.refits_due(100, 110) == 2
    model.alpha = 0.9  # guidance still asks it
    assert model.refits_due(100, 110) == 10


@pytest.mark.parametrize("value", [-0.1, float("nan")])
def test_negative_coefficient_is_refused(value):
    with pytest.raises(ValueError, match=r"^`permissibility_coef` must be at least 0, but is "):
        build(DDPGAP, permissibility_coef=value)
