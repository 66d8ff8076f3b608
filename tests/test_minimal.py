"""`examples/ddpg_ap_minimal.py` takes the package's decisions, given the same weights, K, candidates and draws."""

import ast
import importlib.util
import sys
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from toy import build

from sb3_sap import DDPGAP, KnowledgeBuffer, PermissibilityPredictor
from sb3_sap.guidance.candidates import stratified_candidates
from sb3_sap.predictor.knowledge import LabelledActions

FILE = Path(__file__).resolve().parents[1] / "examples" / "ddpg_ap_minimal.py"
OBS, ACTIONS = spaces.Box(-1, 1, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)


def load():
    spec = importlib.util.spec_from_file_location("ddpg_ap_minimal", FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look
    spec.loader.exec_module(module)
    return module


minimal = load()


def pair(**settings):
    """The predictors of the package and of the example, with the same weights."""
    e = PermissibilityPredictor(OBS, ACTIONS, **settings)
    own = minimal.network(3)
    own.load_state_dict(e.head.state_dict())
    return e, own


def examples(n, seed=0):
    rng = np.random.default_rng(seed)
    obs, actions = rng.uniform(-1, 1, (n, 2)), rng.uniform(-1, 1, (n, 1))
    return LabelledActions(*(np.float32(x) for x in (obs, actions, (actions[:, 0] > obs[:, 0]))))


def test_example_does_not_import_the_package():
    tree = ast.parse(FILE.read_text(encoding="utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name.split(".")[0] for name in imported} - sys.stdlib_module_names == {"gymnasium", "numpy", "torch"}


@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_knowledge_buffers_hold_the_same_tuples(share):
    k = KnowledgeBuffer(OBS, 1, size=100, validation_fraction=0.2, seed=3, min_per_class=8)
    own = {"train": minimal.Knowledge(80, 8), "validation": minimal.Knowledge(20, 8)}
    split = np.random.default_rng()
    split.bit_generator.state = k.rng.bit_generator.state
    data, labels = examples(500), np.random.default_rng(1).random(500) < share
    k.add(data.observations, data.actions, labels)
    for obs, action, label in zip(data.observations, data.actions, labels, strict=True):
        own["validation" if split.random() < 0.2 else "train"].add(obs, action, int(label))
    for part, mine in own.items():
        for label in (0, 1):
            slots = k._offset[part] + k.parts[part].slots(label)
            held = Counter((*k.observations[""][s].tolist(), *k.actions[s].tolist()) for s in slots)
            assert held == Counter((*obs.tolist(), *action.tolist()) for obs, action in mine.classes[label])


def test_sample_of_the_example_is_balanced_and_comes_from_k():
    k = minimal.Knowledge(50, 5)
    data = examples(40)
    for obs, action, label in zip(*data, strict=True):
        k.add(obs, action, int(label))
    obs, actions, labels = k.sample(np.random.default_rng(0), 20)
    assert (obs.shape, actions.shape, labels.sum().item()) == ((20, 2), (20, 1), 10)
    assert ((actions[:, 0] > obs[:, 0]) == (labels > 0)).all()
    assert 0 < labels[:10].sum() < 10  # in random order


def test_fits_change_the_weights_alike():
    e, own = pair(optimizer_class="SGD", learning_rate=0.01, weight_decay=0.01, batch_size=128)
    optimizer = th.optim.SGD(own.parameters(), 0.01, weight_decay=0.01)
    for seed in range(3):
        data = examples(300, seed)
        e.fit(data)
        minimal.fit(own, optimizer, [th.as_tensor(x) for x in data], 128)
    for name, value in e.head.state_dict().items():
        th.testing.assert_close(own.state_dict()[name], value)
    held_out = examples(500, 9)
    assert minimal.balanced_accuracy(own, [th.as_tensor(x) for x in held_out]) == pytest.approx(
        np.mean(e.recall(held_out))
    )


def test_candidates_are_the_same():
    ones = np.ones((1, 1))
    theirs = stratified_candidates(np.random.default_rng(5), -ones, ones, 128)[0]
    np.testing.assert_allclose(minimal.sample_candidates(np.random.default_rng(5), 128), theirs, atol=1e-6)


def test_algorithm_1_takes_the_same_decisions():
    model = build(DDPGAP, predictor_kwargs={"net_arch": [128, 256]}, alpha=0.7)
    model.learn(5)
    model.predictor.n_updates += 1
    model.validation_accuracy = 1.0
    own = minimal.network(3)
    own.load_state_dict(model.predictor.head.state_dict())
    with th.no_grad():  # permissible and rejected actions, and states in which no candidate is permissible
        for head in (own, model.predictor.head):
            head[-1].bias -= 0.06
    outcomes = Counter()
    rng = np.random.default_rng(0)
    for seed in range(300):
        obs, action = np.float32(rng.uniform(-3, 3, (1, 2))), np.float32(rng.uniform(-1, 1, (1, 1)))
        candidates = np.float32(rng.uniform(-1, 1, (16, 1)))
        model.sample_candidates = lambda rows, n_envs, given=candidates: (given[None], np.ones((1, 16), bool))
        model._last_obs, model.exploration_rng = obs, np.random.default_rng(seed)
        guided = model.guide(action)
        theirs = action[0] if guided is None else guided[0]
        mine = minimal.select_action(
            np.random.default_rng(seed), own, obs[0], action[0], 0.7, lambda given=candidates: given
        )
        assert mine == theirs
        outcomes[guided is None] += 1
    assert min(outcomes.values()) > 30


@pytest.mark.slow
def test_example_learns_to_keep_the_lane():
    def env(**options):
        return gym.make("sb3_sap:sap/LaneKeeping-v0", **options)

    args = minimal.Args(steps=1_500, dataset_size=500)
    trained = minimal.train(args, env(track="wheel-2", laps=None))
    untrained = minimal.network(5, th.nn.Tanh())
    score = {actor: minimal.drive(actor, env(track="g-track-3"))[0] for actor in (trained, untrained)}
    assert score[trained] > 5_000 > 5 * score[untrained]
