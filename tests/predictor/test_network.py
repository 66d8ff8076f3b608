"""The predictor E: one step computed by hand, what it learns, its optimizers and its layers."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from torch import nn

from sb3_sap import PermissibilityPredictor
from sb3_sap.common.spaces import joint_actions
from sb3_sap.predictor.knowledge import LabelledActions
from sb3_sap.predictor.pairs import ManyActions, judge

OBS, ACTIONS = spaces.Box(-1, 1, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)


def predictor(**settings):
    with th.random.fork_rng():
        th.manual_seed(0)
        return PermissibilityPredictor(OBS, ACTIONS, **settings)


def dataset(obs, actions, labels):
    return LabelledActions(np.float32(obs), np.float32(actions), np.float32(labels))


def test_sgd_step_follows_equation_7():
    # Without hidden layers E is σ(w·x + b) and, from zero weights, σ = 1/2: the gradient of the mean cross-entropy
    # is the mean of (1/2 - label)·x.
    e = predictor(net_arch=[], learning_rate=1.0, weight_decay=0.5, optimizer_class="SGD")
    with th.no_grad():
        e.head[0].weight.zero_()
        e.head[0].bias.zero_()
    data = dataset([[1, 0], [0, 1]], [[1], [-1]], [1, 0])
    # x = (1, 0, 1) labelled 1: -1/2 x; x = (0, 1, -1) labelled 0: +1/2 x; their mean is (-1/4, 1/4, -1/2), bias 0.
    assert e.fit(data) == pytest.approx(np.log(2))
    np.testing.assert_allclose(e.head[0].weight.detach()[0], [0.25, -0.25, 0.5], atol=1e-6)
    assert e.head[0].bias.item() == pytest.approx(0)


def test_weight_decay_adds_lambda_theta_to_the_gradient_of_the_cross_entropy():
    rate, decay = 0.1, 0.3
    e = predictor(net_arch=[4], learning_rate=rate, weight_decay=decay, optimizer_class="SGD")
    before = [p.detach().clone() for p in e.parameters()]
    data = dataset([[0.5, -1], [0.2, 0.3], [1, 1]], [[0.1], [-0.7], [0.4]], [1, 0, 0])
    x = th.cat([th.tensor(data.observations), th.tensor(data.actions)], dim=1)
    probabilities = th.sigmoid(e.head(x))[:, 0]
    label = th.tensor(data.labels)
    cross_entropy = -(label * probabilities.log() + (1 - label) * (1 - probabilities).log()).mean()  # Eq. (7)
    gradients = th.autograd.grad(cross_entropy, list(e.parameters()))
    assert e.fit(data) == pytest.approx(cross_entropy.item(), rel=1e-5)
    for old, gradient, new in zip(before, gradients, e.parameters(), strict=True):
        th.testing.assert_close(new.detach(), old - rate * (gradient + decay * old))


def test_fit_takes_every_mini_batch_once_and_returns_their_mean_loss():
    e = predictor(net_arch=[], learning_rate=0.0, batch_size=4, optimizer_class="SGD")
    assert not e.fitted
    rows = np.arange(10)
    data = dataset(np.stack([rows, -rows], 1) / 10, rows[:, None] / 10, rows % 2)
    losses = [e.fit(LabelledActions(*(part[cut] for part in data))) for cut in (slice(4), slice(4, 8), slice(8, 10))]
    assert int(e.n_updates) == 3
    assert e.fit(data) == pytest.approx(np.mean(losses))
    assert int(e.n_updates) == 6
    assert e.fitted


def threshold_data(rng, n):
    """Permissible where the action is above the first observation; nothing within 0.1 of the border."""
    obs, actions = rng.uniform(-1, 1, (n, 2)), rng.uniform(-1, 1, (n, 1))
    clear = np.abs(actions[:, 0] - obs[:, 0]) > 0.1
    return dataset(obs[clear], actions[clear], actions[clear, 0] > obs[clear, 0])


@pytest.mark.parametrize("settings", [{}, {"optimizer_class": "SGD", "learning_rate": 0.1}])
def test_predictor_learns_a_threshold_that_depends_on_the_state(settings):
    rng = np.random.default_rng(0)
    e = predictor(net_arch=[32], **settings)
    unseen = threshold_data(rng, 500)
    assert sum(e.recall(unseen)) < 1.6
    for _ in range(100):
        e.fit(threshold_data(rng, 512))
    assert min(e.recall(unseen)) > 0.97


def test_recall_is_the_accuracy_within_each_class():
    e = predictor(net_arch=[])
    with th.no_grad():  # logit = action: permissible above zero
        e.head[0].weight.copy_(th.tensor([[0.0, 0.0, 1.0]]))
        e.head[0].bias.zero_()
    actions = [[0.5], [-0.5], [0.2], [0.1], [-0.1], [0.0]]
    labels = [1, 1, 1, 0, 0, 0]  # right: yes, no, yes, no, yes, yes (a logit of 0 is not permissible)
    assert e.recall(dataset(np.zeros((6, 2)), actions, labels)) == (pytest.approx(2 / 3), pytest.approx(2 / 3))
    assert e.recall(dataset(np.zeros((5, 2)), actions[:5], labels[:5])) == (pytest.approx(1 / 2), pytest.approx(2 / 3))


def test_default_network_is_that_of_the_paper():
    shapes = [tuple(layer.weight.shape) for layer in predictor().head if isinstance(layer, nn.Linear)]
    assert shapes == [(128, 3), (256, 128), (1, 256)]


@pytest.mark.parametrize("name", ["SGD", "Adam", "AdamW", "RMSprop"])
def test_optimizers_are_given_by_name_or_class(name):
    for given in (name, getattr(th.optim, name)):
        optimizer = predictor(optimizer_class=given, learning_rate=0.01, weight_decay=0.02).optimizer
        assert type(optimizer) is getattr(th.optim, name)
        (group,) = optimizer.param_groups
        assert (group["lr"], group["weight_decay"]) == (0.01, 0.02)


def test_optimizer_kwargs_reach_the_optimizer():
    e = predictor(optimizer_class="SGD", optimizer_kwargs={"momentum": 0.9})
    assert e.optimizer.param_groups[0]["momentum"] == 0.9


@pytest.mark.parametrize("name", ["Adamm", "sgd", "lr_scheduler", "Tensor"])
def test_unknown_optimizers_are_refused(name):
    with pytest.raises(ValueError, match=rf"`optimizer_class` = '{name}' names no optimizer of torch.optim"):
        predictor(optimizer_class=name)


def test_dict_observations_are_concatenated_with_the_action():
    space = spaces.Dict({"a": spaces.Box(-1, 1, (1,)), "b": spaces.Box(-1, 1, (2,))})
    e = PermissibilityPredictor(space, ACTIONS, net_arch=[8], batch_size=2, features_extractor_class=CombinedExtractor)
    obs = {"a": np.float32([[0.1], [0.2], [0.3]]), "b": np.float32([[1, 2], [3, 4], [5, 6]])}
    data = LabelledActions(obs, np.float32([[1], [0], [-1]]), np.float32([1, 0, 1]))
    x = th.tensor([[0.1, 1, 2, 1], [0.2, 3, 4, 0], [0.3, 5, 6, -1]])
    logits = e({key: th.tensor(value) for key, value in obs.items()}, th.tensor(data.actions))
    th.testing.assert_close(logits, e.head(x)[:, 0])
    e.fit(data)
    assert int(e.n_updates) == 2


def test_images_are_scaled_and_the_predictors_own_extractor_learns():
    space = spaces.Box(0, 255, (1, 36, 36), np.uint8)
    e = PermissibilityPredictor(
        space, ACTIONS, net_arch=[8], features_extractor_class=NatureCNN, features_extractor_kwargs={"features_dim": 4}
    )
    images = np.random.default_rng(0).integers(0, 256, (6, 1, 36, 36), dtype=np.uint8)
    data = LabelledActions(images, np.zeros((6, 1), np.float32), np.float32([0, 1] * 3))
    th.testing.assert_close(e.features(th.tensor(images)), e.features_extractor(th.tensor(images).float() / 255))
    before = e.features_extractor.cnn[0].weight.detach().clone()
    e.fit(data)
    assert not th.equal(before, e.features_extractor.cnn[0].weight)


def test_loaded_state_is_marked_as_fitted():
    e, fresh = predictor(net_arch=[4]), predictor(net_arch=[4])
    e.fit(dataset([[0, 0]], [[0]], [1]))
    assert not fresh.fitted
    fresh.load_state_dict(e.state_dict())
    assert fresh.fitted


class Normalising(BaseFeaturesExtractor):
    """Layers that act differently in training and in evaluation."""

    def __init__(self, space, layer):
        super().__init__(space, 2)
        self.layer = {"batch norm": nn.BatchNorm1d(2, momentum=1.0), "dropout": nn.Dropout(0.5)}[layer]

    def forward(self, observations):
        return self.layer(observations)


def with_layer(layer, **settings):
    return predictor(
        net_arch=[8],
        features_extractor_class=Normalising,
        features_extractor_kwargs={"layer": layer},
        **settings,
    )


EXAMPLES = dataset([[10, 1], [12, 3], [14, 5], [16, 7], [18, 9]], np.zeros((5, 1)), [0, 1, 0, 1, 0])


def test_batch_norm_statistics_change_in_fits_only():
    e = with_layer("batch norm", batch_size=4, learning_rate=0.0)
    e.fit(EXAMPLES)  # in one batch: the last row has no variance of its own
    mean = th.tensor([14.0, 5.0])
    th.testing.assert_close(e.features_extractor.layer.running_mean, mean)
    for rows in (EXAMPLES, LabelledActions(*(part[:2] for part in EXAMPLES))):
        e.recall(rows)
    one = e.features(th.tensor([[14.0, 5.0]]))
    th.testing.assert_close(one, th.zeros(1, 2))
    th.testing.assert_close(e.features_extractor.layer.running_mean, mean)
    assert not e.training


def test_dropout_is_active_in_fits_only_and_leaves_the_global_generator_unchanged():
    before = th.get_rng_state()
    e, same = with_layer("dropout"), with_layer("dropout")
    assert e.fit(EXAMPLES) == same.fit(EXAMPLES)
    assert e.fit(EXAMPLES) == same.fit(EXAMPLES)
    obs, actions = th.tensor(EXAMPLES.observations), th.tensor(EXAMPLES.actions)
    th.testing.assert_close(e(obs, actions), e(obs, actions), rtol=0, atol=0)
    assert th.equal(th.get_rng_state(), before)
    losses = {e.loss(obs, actions, th.tensor(EXAMPLES.labels)).item() for _ in range(2)}
    with e._training():
        losses.add(e.loss(obs, actions, th.tensor(EXAMPLES.labels)).item())
    assert len(losses) == 2


@pytest.mark.parametrize(
    "space", [spaces.Discrete(80), spaces.Discrete(9), spaces.MultiDiscrete([16, 5]), spaces.MultiBinary(7)]
)
def test_many_actions_are_judged_as_each_of_them_is(space):
    e = PermissibilityPredictor(spaces.Box(-1, 1, (3,)), space, net_arch=[8, 8])
    features, actions = th.rand(4, 3), joint_actions(space)
    actions = th.as_tensor(actions.reshape(len(actions), -1))
    k = len(actions)
    each = e.logits(features.repeat_interleave(k, dim=0), actions.repeat(4, 1)).reshape(4, k)
    th.testing.assert_close(th.cat(ManyActions(e, actions).logits(features.split(3))), each)
    th.testing.assert_close(judge(e, features, actions.expand(4, -1, -1)), each)
    some = actions[th.tensor([[3, 1], [2, 5], [0, 4], [7, 7]])]
    th.testing.assert_close(judge(e, features, some)[2, 1], each[2, 4])


def test_an_output_for_each_action_judges_all_of_them_alike():
    space = spaces.Discrete(7)
    e = PermissibilityPredictor(spaces.Box(-1, 1, (3,)), space, net_arch=[8], output_per_action=True, threshold=0.3)
    features, actions = th.rand(4, 3), th.arange(7)[:, None]
    each = e.logits(features.repeat_interleave(7, dim=0), actions.repeat(4, 1)).reshape(4, 7)
    th.testing.assert_close(each, e.head(features) - e.offset)
    th.testing.assert_close(judge(e, features, actions.expand(4, -1, -1)), each)
    th.testing.assert_close(judge(e, features[:1], actions[None, 3:5]), each[:1, 3:5])
    th.testing.assert_close(th.cat(ManyActions(e, actions[2:]).logits(features.split(3))), each[:, 2:])


def test_an_output_for_each_action_learns_and_is_saved(tmp_path):
    e = PermissibilityPredictor(spaces.Box(-1, 1, (1,)), spaces.Discrete(30), net_arch=[32], output_per_action=True)
    rng = np.random.default_rng(0)
    for _ in range(150):
        obs, actions = rng.uniform(-1, 1, (512, 1)), rng.integers(0, 30, (512, 1))
        e.fit(dataset(obs, actions, (actions[:, 0] / 15 - 1 < obs[:, 0])))
    obs, actions = rng.uniform(-1, 1, (1000, 1)), rng.integers(0, 30, (1000, 1))
    assert min(e.recall(dataset(obs, actions, actions[:, 0] / 15 - 1 < obs[:, 0]))) > 0.9
    e.save(tmp_path / "e.pt")
    loaded = PermissibilityPredictor.load(tmp_path / "e.pt")
    assert loaded.output_per_action
    th.testing.assert_close(loaded.probabilities(obs, actions), e.probabilities(obs, actions))


@pytest.mark.parametrize(
    ("space", "parts", "said"),
    [
        (ACTIONS, None, "for the action space Box"),
        (spaces.MultiDiscrete([2, 2]), None, "for the action space MultiDiscrete"),
        (spaces.MultiDiscrete([2, 2]), {"one": [0], "other": [1]}, "for `action_parts`"),
    ],
)
def test_an_output_for_each_action_needs_single_actions(space, parts, said):
    with pytest.raises(ValueError, match=f"`output_per_action` is for Discrete actions without parts, not {said}"):
        PermissibilityPredictor(OBS, space, action_parts=parts, output_per_action=True)


def test_output_per_action_is_a_yes_or_no():
    with pytest.raises(ValueError, match="`output_per_action` must be True or False, but is 3"):
        PermissibilityPredictor(OBS, spaces.Discrete(3), output_per_action=3)


def test_actions_are_judged_anew_after_a_fit():
    e = PermissibilityPredictor(spaces.Box(-1, 1, (3,)), spaces.Discrete(5), net_arch=[8])
    many, features = ManyActions(e, th.arange(5)), th.rand(2, 3)
    before = many.logits([features])[0]
    with th.no_grad():
        e.head[0].weight += 1.0
    e.n_updates += 1
    after = many.logits([features])[0]
    assert not th.equal(before, after)
    each = e.logits(features.repeat_interleave(5, dim=0), th.arange(5).repeat(2)[:, None]).reshape(2, 5)
    th.testing.assert_close(after, each)


@pytest.mark.parametrize("space", [spaces.MultiDiscrete([4, 2, 3]), spaces.MultiBinary(3)])
def test_part_of_a_finite_action_is_judged_from_its_own_dimensions_alone(space):
    e = PermissibilityPredictor(
        spaces.Box(-1, 1, (3,)), space, net_arch=[8, 8], action_parts={"middle": [1], "rest": [2, 0]}
    )
    e.accuracies[:] = 1.0
    features, actions = th.rand(4, 3), joint_actions(space)
    k, whole = len(actions), th.as_tensor(actions)
    each = e.part_logits(features.repeat_interleave(k, dim=0), whole.repeat(4, 1)).reshape(4, k, 2)
    choices = [th.as_tensor(np.unique(actions[:, own], axis=0)) for own in ([1], [2, 0])]
    for part, own in enumerate(([1], [2, 0])):
        alone = th.zeros((len(choices[part]), len(whole[0])), dtype=th.long)
        alone[:, own] = choices[part].long()
        found = th.cat(ManyActions(e, alone, th.full((len(alone),), part)).logits(features.split(3)))
        for column, choice in enumerate(choices[part]):
            same = (whole[:, own] == choice).all(dim=1)
            expected = found[:, column, None].expand(4, int(same.sum()))
            th.testing.assert_close(each[:, same, part], expected)
    th.testing.assert_close(th.cat(ManyActions(e, whole).logits(features.split(3))), each.min(dim=2).values)


def test_part_of_a_finite_action_is_learned_from_the_rows_that_have_its_label():
    space = spaces.MultiDiscrete([2, 2])
    e = PermissibilityPredictor(spaces.Box(-1, 1, (3,)), space, net_arch=[8], action_parts={"a": [0], "b": [1]})
    obs, actions = th.rand(4, 3), th.as_tensor(joint_actions(space))
    labels = th.tensor([[1.0, th.nan], [th.nan, 0.0], [0.0, 1.0], [th.nan, th.nan]])
    logits = e.part_logits(obs, actions)
    known = th.stack([logits[0, 0], logits[1, 1], logits[2, 0], logits[2, 1]])
    expected = th.nn.functional.binary_cross_entropy_with_logits(known, th.tensor([1.0, 0.0, 0.0, 1.0]))
    th.testing.assert_close(e.loss(obs, actions, labels), expected)
