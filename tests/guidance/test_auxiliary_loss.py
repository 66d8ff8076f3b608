"""The auxiliary (permissibility) loss: which parameters it changes, in which direction, and how often."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import set_random_seed
from torch.nn import functional as F
from toy import DISCRETE, GUIDED, Line, build

from sb3_sap import DDPGAP, DQNAP, QRDQNAP, SACAP, TD3AP, CrossQAP
from sb3_sap.guidance.auxiliary_loss import permissible_actor_step, permissible_value_step
from sb3_sap.guidance.values import action_values

WIDE = {"predictor_kwargs": {"net_arch": [32]}, "dataset_size": 64, "policy_kwargs": {"net_arch": [32]}}


def mean_action(model, observations):
    return model.predict(observations, deterministic=True)[0]


def weights(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def states(model, n):
    return model.replay_buffer.sample(n).observations


def same(one, other):
    return all(th.equal(value, other[name]) for name, value in one.items())


def test_actor_step_follows_the_gradient_of_the_cross_entropy():
    model = build(DDPGAP).learn(40)
    model.actor.optimizer = th.optim.SGD(model.actor.parameters(), lr=0.5)
    before = weights(model.actor)
    set_random_seed(0)
    observations = model.replay_buffer.sample(8).observations
    labels = th.ones(8)
    expected = 2.0 * F.binary_cross_entropy_with_logits(
        model.predictor(observations, model.actor(observations)), labels
    )
    gradients = th.autograd.grad(expected, list(model.actor.parameters()))
    set_random_seed(0)
    loss = permissible_actor_step(model.actor, model.predictor, states(model, 8), 2.0)
    assert loss == pytest.approx(expected.item())
    for (name, parameter), gradient in zip(model.actor.named_parameters(), gradients, strict=True):
        th.testing.assert_close(parameter, before[name] - 0.5 * gradient)


@pytest.mark.parametrize("algorithm", GUIDED)
def test_actor_step_changes_the_actor_only(algorithm):
    model = build(algorithm).learn(60)
    predictor, critic, actor = weights(model.predictor), weights(model.critic), weights(model.actor)
    gradients = {name: parameter.grad.clone() for name, parameter in model.predictor.named_parameters()}
    model.policy.set_training_mode(True)
    permissible_actor_step(model.actor, model.predictor, states(model, 8), 1.0)
    assert same(weights(model.predictor), predictor)
    assert same(gradients, {name: parameter.grad for name, parameter in model.predictor.named_parameters()})
    assert same(weights(model.critic), critic)
    assert not same(weights(model.actor), actor)


def test_actor_step_leaves_running_statistics_unchanged():
    model = build(CrossQAP).learn(60)
    before = {name: value.clone() for name, value in model.actor.named_buffers()}
    assert before
    model.policy.set_training_mode(True)
    permissible_actor_step(model.actor, model.predictor, states(model, 8), 1.0)
    assert same(dict(model.actor.named_buffers()), before)


def test_actor_step_leaves_the_standard_deviation_of_a_stochastic_policy_unchanged():
    model = build(SACAP).learn(60)
    before = weights(model.actor.log_std)
    permissible_actor_step(model.actor, model.predictor, states(model, 8), 1.0)
    assert same(weights(model.actor.log_std), before)


@pytest.mark.parametrize("algorithm", GUIDED)
def test_actor_steps_lead_to_actions_that_are_predicted_permissible(algorithm):
    """The predictor learns from 400 random steps; right of the centre only going left is permissible."""
    model = build(algorithm, learning_starts=400, learning_rate=0.01, **WIDE).learn(400)
    assert model.validation_accuracy > 0.7
    for _ in range(200):
        permissible_actor_step(model.actor, model.predictor, states(model, 32), 1.0)
    rows = np.array([[-0.8, 0.5], [-0.4, 0.5], [0.4, 0.5], [0.8, 0.5]], dtype=np.float32)
    assert np.array_equal(np.sign(mean_action(model, rows)[:, 0]), [1, 1, -1, -1])


def test_coefficient_of_zero_changes_no_bit_and_a_schedule_is_followed():
    plain, zero = build(DDPGAP).learn(80), build(DDPGAP, actor_permissibility_coef=lambda _: 0.0).learn(80)
    assert same(weights(plain.policy), weights(zero.policy))
    some = build(DDPGAP, actor_permissibility_coef=lambda remaining: remaining).learn(80)
    assert not same(weights(plain.policy), weights(some.policy))
    from_yaml = build(DDPGAP, actor_permissibility_coef="lin_1.0").learn(80)
    assert same(weights(some.policy), weights(from_yaml.policy))


@pytest.mark.parametrize("value", ["const_1", "lin_", "lin_x", "1"])
def test_invalid_schedule_is_refused(value):
    with pytest.raises(
        ValueError, match=r"`actor_permissibility_coef` must be a number, a schedule or \"lin_<number>\""
    ):
        build(DDPGAP, actor_permissibility_coef=value)


def test_auxiliary_loss_is_not_applied_while_the_predictor_is_inaccurate(monkeypatch):
    calls = []
    monkeypatch.setattr(
        "sb3_sap.guidance.auxiliary_update.permissible_actor_step", lambda *args: calls.append(args) or 0.0
    )
    model = build(DDPGAP, actor_permissibility_coef=1.0)
    model.learn(60)
    calls.clear()
    model.validation_accuracy = 0.69
    model.train(1, 8)
    assert not calls
    model.validation_accuracy = 0.7
    model.train(3, 8)
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("algorithm", "growths", "numbers"),
    [
        (DDPGAP, {"refit_growth": 0.25}, [1, 2, 2, 5]),  # to 3, 4, 5 and 9 updates: of these 3, 4, 6, 7 and 9 are due
        (DDPGAP, {"refit_growth": 0.25, "teaching_growth": 0.0}, [1, 2, 3, 7]),
        (DDPGAP, {"teaching_growth": 0.25}, [1, 2, 2, 5]),
        (TD3AP, {}, [1, 2, 3, 7]),
        (TD3AP, {"teaching_growth": 0.0}, [0, 1, 1, 3]),  # TD3 updates its actor once every two critic updates
    ],
)
def test_auxiliary_loss_follows_the_schedule_of_the_fits_or_its_own(monkeypatch, algorithm, growths, numbers):
    calls = []
    monkeypatch.setattr(
        "sb3_sap.guidance.auxiliary_update.permissible_actor_step", lambda *args: calls.append(args) or 0.0
    )
    model = build(algorithm, actor_permissibility_coef=1.0, **growths).learn(60)
    model.validation_accuracy, model._n_updates = 1.0, 2
    calls.clear()
    counted = []
    for updates in (1, 1, 1, 4):
        model.train(updates, 8)
        counted.append(len(calls))
    assert counted == numbers


@pytest.mark.parametrize(("growth", "last"), [(None, 59), (0.0, 100)])
def test_auxiliary_loss_ends_with_guidance_unless_it_has_its_own_schedule(monkeypatch, growth, last):
    steps = []
    monkeypatch.setattr(DDPGAP, "predictor_accurate", True)
    model = build(DDPGAP, actor_permissibility_coef=1.0, guidance_end=60, teaching_growth=growth)
    monkeypatch.setattr(
        "sb3_sap.guidance.auxiliary_update.permissible_actor_step",
        lambda *args: steps.append(model.num_timesteps) or 0.0,
    )
    model.learn(100)
    assert max(steps) == last


# ------------------------------------------------------------------ discrete actions


class Permits:
    """A predictor that permits the given actions where x > 0, and every action elsewhere."""

    def __init__(self, *actions):
        self.actions = th.tensor(actions)

    def features(self, obs):
        return obs

    def logits(self, features, actions):
        return th.where((features[:, 0] > 0) & ~th.isin(actions.flatten(), self.actions), -1.0, 1.0)


def discrete(algorithm, **settings):
    return build(algorithm, Line(n_actions=3), predictor_gradient_steps=-1, **settings).learn(60)


@pytest.mark.parametrize("algorithm", DISCRETE)
def test_value_step_moves_rejected_values_below_the_best_permitted_value(algorithm):
    model = discrete(algorithm)
    model.policy.optimizer = th.optim.SGD(model.policy.parameters(), lr=0.5)
    net = model.q_net if algorithm is DQNAP else model.quantile_net
    before, target = weights(net), weights(model.policy)
    set_random_seed(0)
    observations = model.replay_buffer.sample(32).observations
    right = observations[:, 0] > 0
    assert 0 < right.sum() < 32
    values = net(observations) if algorithm is DQNAP else net(observations).mean(dim=1)
    # Where x > 0, action 0 is rejected; it is compared with the better one of 1 and 2.
    excess = values[right, 0] - values[right, 1:].max(dim=1).values
    expected = 2.0 * th.log1p(th.exp(excess)).mean()
    gradients = th.autograd.grad(expected, list(net.parameters()))
    set_random_seed(0)
    loss = permissible_value_step(model, Permits(1, 2), states(model, 32), 2.0)
    assert loss == pytest.approx(expected.item(), rel=1e-5)
    for (name, parameter), gradient in zip(net.named_parameters(), gradients, strict=True):
        th.testing.assert_close(parameter, before[name] - 0.5 * gradient)
    targets = {name: value for name, value in weights(model.policy).items() if "target" in name}
    assert targets
    assert same(targets, target)


@pytest.mark.parametrize("permitted", [(), (0, 1, 2)])
def test_value_step_changes_nothing_if_all_or_no_actions_are_permitted(permitted):
    model = discrete(DQNAP)
    before = weights(model.policy)
    assert permissible_value_step(model, Permits(*permitted), states(model, 32), 1.0) == 0.0
    assert same(weights(model.policy), before)


@pytest.mark.parametrize("algorithm", DISCRETE)
def test_value_steps_lead_to_greedy_actions_that_are_predicted_permissible(algorithm):
    settings = {"learning_starts": 400, "learning_rate": 0.01, "predictor_gradient_steps": -1, **WIDE}
    model = build(algorithm, Line(n_actions=2), **settings).learn(400)
    assert model.validation_accuracy > 0.7
    for _ in range(200):
        permissible_value_step(model, model.predictor, states(model, 32), 1.0)
    rows = np.array([[-0.8, 0.5], [-0.4, 0.5], [0.4, 0.5], [0.8, 0.5]], dtype=np.float32)
    assert model.predict(rows, deterministic=True)[0].tolist() == [1, 1, 0, 0]


def test_auxiliary_loss_changes_values_in_training_and_a_coefficient_of_zero_no_bit():
    plain, zero, some = (discrete(QRDQNAP, actor_permissibility_coef=coef) for coef in (0.0, lambda _: 0.0, 1.0))
    assert same(weights(plain.policy), weights(zero.policy))
    assert not same(weights(plain.policy), weights(some.policy))
    assert action_values(some, th.zeros(5, 2)).shape == (5, 3)


class Frozen(FlattenExtractor):
    """The first layer is not trained."""

    def __init__(self, space):
        super().__init__(space)
        self.layer = th.nn.Linear(2, 2).requires_grad_(False)

    def forward(self, observations):
        return self.layer(super().forward(observations))


@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP, CrossQAP, *DISCRETE])
def test_frozen_layers_remain_unchanged_while_the_others_learn(algorithm):
    policy_kwargs = {"net_arch": [8], "features_extractor_class": Frozen}
    model = build(algorithm, policy_kwargs=policy_kwargs, actor_permissibility_coef=1.0)
    before = weights(model.policy)
    model.validation_accuracy = 1.0
    model.learn(60)
    after = weights(model.policy)
    changed = {name for name, value in before.items() if not th.equal(value, after[name])}
    assert changed
    assert not [name for name in changed if "extractor" in name and "target" not in name]  # Polyak averaging rounds


def test_fully_frozen_actor_remains_unchanged():
    model = build(DDPGAP).learn(30)
    model.actor.requires_grad_(False)
    before = weights(model.actor)
    permissible_actor_step(model.actor, model.predictor, states(model, 8), 1.0)
    assert same(before, weights(model.actor))
