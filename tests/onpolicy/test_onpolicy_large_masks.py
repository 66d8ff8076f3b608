"""Masks of more combinations than can be judged one by one: by parts, by dimensions, and block after block."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rollouts import MULTI_BINARY, MULTI_DISCRETE, Agrees, Recorder, build_on_policy, even, judged_by
from stable_baselines3.common.logger import Logger

from sb3_sap import A2CAP, PPOAP, TRPOAP, RecurrentPPOAP
from sb3_sap.common.spaces import joint_actions
from sb3_sap.onpolicy import choosing, conditional
from sb3_sap.onpolicy.conditional import ConditionalGuide
from sb3_sap.onpolicy.enumerated import EnumeratedGuide
from sb3_sap.onpolicy.factored import FactoredGuide
from sb3_sap.onpolicy.known import KnownMasks

LARGE = spaces.MultiDiscrete([3] * 8)  # 6,561 combinations


def labels_of(k):
    return lambda obs, actions, next_obs: np.zeros((len(actions), k), dtype=bool)


def model_of_parts(parts, space, weights, algorithm=PPOAP, **settings):
    """A model whose E permits what has a positive weight: one for each part and each choice of each dimension."""
    model = build_on_policy(
        algorithm,
        Recorder(space),
        ap_function=labels_of(len(parts)),
        action_parts=parts,
        **{"predictor_kwargs": {"net_arch": []}, "min_per_class": 1_000} | settings,
    )
    head = model.predictor.head[0]
    th.nn.init.zeros_(head.weight)
    th.nn.init.zeros_(head.bias)
    head.weight.data[:, 2:] = th.as_tensor(weights)  # after the two of the observation
    model.predictor.accuracies[:] = 1.0
    model.predictor.n_updates += 1
    model.agreement = Agrees()
    model.set_logger(Logger(None, []))
    return model


def log_probs(guide, model, obs, actions):
    """(n, k) of every action in every state, in the rollout's distribution."""
    plain = model.policy.get_distribution(obs)
    return th.stack([guide.distribution(obs, plain).log_prob(a.repeat(len(obs), 1)) for a in actions], dim=1)


def every_action(space):
    return th.as_tensor(joint_actions(space)).long()


@pytest.mark.parametrize("space", [spaces.MultiDiscrete([3, 2, 2]), spaces.MultiBinary(4)], ids=str)
def test_masks_of_parts_are_those_of_all_combinations(space):
    width = 7 if isinstance(space, spaces.MultiDiscrete) else 4
    th.manual_seed(0)
    model = model_of_parts({"a": [2, 0], "b": [1]}, space, th.randn(2, width))
    model.predictor.head[0].weight.data[:, :2] = th.randn(2, 2)
    model.predictor.head[0].bias.data[:] = 0.5
    th.nn.init.normal_(model.policy.action_net.weight)
    guide, obs = model._guide(), th.rand(40, 2)
    assert isinstance(guide, FactoredGuide)
    whole = EnumeratedGuide(model.predictor, space, KnownMasks(guide.known.sizes), model.device)
    some = th.stack([mask.any(dim=1) for mask in raw_masks(guide, obs)]).all(dim=0)  # of each part something
    assert some.sum() > 10
    with th.no_grad():
        by_part, enumerated = (log_probs(one, model, obs[some], every_action(space)) for one in (guide, whole))
        th.testing.assert_close(by_part.exp(), enumerated.exp(), rtol=1e-4, atol=1e-6)
        th.testing.assert_close(by_part.exp().sum(dim=1), th.ones(int(some.sum())))
        th.testing.assert_close(
            guide.losses(obs[some], model.policy.get_distribution(obs[some])),
            whole.losses(obs[some], model.policy.get_distribution(obs[some])),
        )
    assert (by_part < -20).any()


def raw_masks(guide, obs):
    return th.as_tensor(guide._judge(obs)).split([len(block) for block in guide._judged], dim=1)


@pytest.mark.parametrize("algorithm", [PPOAP, A2CAP, TRPOAP, RecurrentPPOAP])
def test_part_whose_choices_are_all_rejected_is_free_and_the_others_are_not(algorithm):
    weights = [[1, -1, 1] + [0] * 21, [0] * 3 + [-1] * 3 + [0] * 18]  # part 0: the choices 0 and 2, part 1: none
    model = model_of_parts({"one": [0], "two": [1]}, LARGE, weights, algorithm)
    env = model.env.envs[0].unwrapped
    model.learn(48)
    executed = np.array([action for _, action in env.executed])
    assert set(executed[:, 0]) == {0, 2}
    assert all(set(column) == {0, 1, 2} for column in executed[:, 1:].T)


def test_part_that_is_not_accurate_restricts_nothing():
    model = model_of_parts({"one": [0], "two": [1]}, LARGE, [[-1, 1, -1] + [0] * 21, [0] * 3 + [-1, -1, 1] + [0] * 18])
    model.predictor.accuracies[1] = 0.6
    model.learn(32)
    executed = np.array([action for _, action in model.env.envs[0].unwrapped.executed])
    assert set(executed[:, 0]) == {1}
    assert set(executed[:, 1]) == {0, 1, 2}


@pytest.fixture
def small_limit(monkeypatch):
    """Six combinations are too many, and a block has one dimension."""
    monkeypatch.setattr(choosing, "MOST_COMBINATIONS", 4)
    monkeypatch.setattr(conditional, "BLOCK", 3)


def probabilities_by_hand(policy, step, completion):
    """Of the actions of ``MultiDiscrete([3, 2])``, of which :func:`even` permits those of an even sum with the step."""
    found = {}
    for one in range(3):
        first = [p if (step + choice + completion[1]) % 2 == 0 else 0.0 for choice, p in enumerate(policy[0])]
        for two in range(2):
            second = [p if (step + one + choice) % 2 == 0 else 0.0 for choice, p in enumerate(policy[1])]
            found[one, two] = first[one] / sum(first) * second[two] / sum(second)
    return [found[action] for action in sorted(found)]


def test_probabilities_block_after_block_are_the_products_of_the_conditional_ones(small_limit):
    model = judged_by(even, PPOAP, Recorder(MULTI_DISCRETE))
    th.nn.init.normal_(model.policy.action_net.weight, std=0.3)
    guide, obs = model._guide(), th.tensor([[0.0, 1.0], [3.0, 1.0]])
    assert isinstance(guide, ConditionalGuide)
    with th.no_grad():
        plain = model.policy.get_distribution(obs)
        found = log_probs(guide, model, obs, every_action(MULTI_DISCRETE)).exp()
        th.testing.assert_close(found.sum(dim=1), th.ones(2))
        for row, step in enumerate((0, 3)):
            policy = [one.probs[row].tolist() for one in plain.distribution]
            completion = [one.argmax(dim=1)[row].item() for one in (each.probs for each in plain.distribution)]
            expected = probabilities_by_hand(policy, step, completion)
            assert found[row].tolist() == pytest.approx(expected, abs=1e-5)
        # Draws follow the probabilities, to four standard deviations.
        many = obs[:1].expand(4_000, 2)
        drawn = guide.distribution(many, model.policy.get_distribution(many)).sample()
    counts = np.bincount(np.ravel_multi_index(drawn.numpy().T, [3, 2]), minlength=6) / 4_000
    deviation = np.sqrt(found[0].numpy() * (1 - found[0].numpy()) / 4_000)
    assert (np.abs(counts - found[0].numpy()) <= 4 * deviation + 1e-9).all()


@pytest.mark.parametrize("algorithm", [PPOAP, A2CAP, RecurrentPPOAP])
@pytest.mark.parametrize("space", [LARGE, spaces.MultiBinary(13)], ids=str)
def test_rejected_action_is_not_executed_where_one_combination_of_a_block_is_permitted(algorithm, space):
    env = Recorder(space)
    model = judged_by(even, algorithm, env)
    model.learn(32)
    assert isinstance(model._rollout_guide, ConditionalGuide)
    assert all((step + int(np.sum(action))) % 2 == 0 for step, action in env.executed)
    assert len({tuple(action) for _, action in env.executed}) > 20


def test_where_nothing_is_permitted_the_policy_draws(small_limit):
    model = judged_by(lambda obs, actions: -th.ones(len(actions)), PPOAP, Recorder(MULTI_BINARY))
    obs, actions = th.rand(3, 2), every_action(MULTI_BINARY)
    with th.no_grad():
        plain = model.policy.get_distribution(obs)
        expected = th.stack([plain.log_prob(a.float().repeat(3, 1)) for a in actions], dim=1)
        th.testing.assert_close(log_probs(model._guide(), model, obs, actions), expected)


@pytest.mark.parametrize("algorithm", [PPOAP, A2CAP, RecurrentPPOAP])
@pytest.mark.parametrize("way", ["parts", "blocks"])
def test_update_begins_with_a_ratio_of_one(algorithm, way):
    settings = {"learning_rate": 0.0, "permissibility_coef": 1.0}
    if way == "parts":
        model = model_of_parts({"one": [0, 1]}, LARGE, [[1, -1, 2, -3, 1, 1] + [0] * 18], algorithm, **settings)
    else:
        model = judged_by(even, algorithm, Recorder(LARGE), **settings)
    found = []
    evaluate = model.policy.evaluate_actions

    def watched(*args, **kwargs):
        result = evaluate(*args, **kwargs)
        found.append(result)
        return result

    model.policy.evaluate_actions = watched
    model.learn(16)
    rollout = model.rollout_buffer.log_probs.reshape(-1)
    if algorithm is RecurrentPPOAP:  # whose batches may be padded
        assert set(np.round(rollout, 3)) <= set(np.round(found[0][1].detach().numpy(), 3))
    else:
        assert np.sort(found[0][1].detach().numpy()) == pytest.approx(np.sort(rollout), abs=1e-5)
    assert all(math.isfinite(value) for value in found[0][2].tolist())
    assert rollout.min() > -10


def test_loss_beside_the_completion_is_that_of_its_blocks(small_limit):
    model = judged_by(even, PPOAP, Recorder(MULTI_DISCRETE))
    obs = th.zeros(1, 2)
    model.policy.action_net.bias.data = th.tensor([3.0, 2.0, 1.0, 0.0, 4.0])  # the completion is (0, 1)
    th.nn.init.zeros_(model.policy.action_net.weight)
    distribution = model.policy.get_distribution(obs)
    first, second = (one.probs[0].tolist() for one in distribution.distribution)
    # At step 0 E permits the first dimension's 1 beside the second's 1, and the second's 0 beside the first's 0.
    expected = -math.log(first[1]) - math.log(second[0])
    assert model._guide().losses(obs, distribution).item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("guided", [False, True])
def test_predictions_are_guided_if_asked_to(guided):
    model = judged_by(even, PPOAP, Recorder(LARGE))
    model.policy.action_net.bias.data = th.tensor([0.0, 1.0, 0.0] * 8)
    th.nn.init.zeros_(model.policy.action_net.weight)
    action, _ = model.predict(np.array([1, 1], np.float32), deterministic=True, guided=guided)
    assert (1 + int(action.sum())) % 2 == (0 if guided else 1)


@pytest.mark.parametrize(
    ("algorithm", "settings", "message"),
    [
        (
            PPOAP,
            {"permissible_actions": lambda obs, actions: np.ones(len(actions), bool)},
            "^`permissible_actions` judges",
        ),
        (PPOAP, {"action_parts": {"all": list(range(8))}}, r"^`action_parts`\['all'\] has 6,561 combinations"),
        (TRPOAP, {}, "^TRPOAP bounds the divergence"),
    ],
)
def test_what_cannot_be_enumerated_is_refused(algorithm, settings, message):
    with pytest.raises(ValueError, match=message):
        build_on_policy(algorithm, Recorder(LARGE), **settings)
