"""E and K without an algorithm, a replay buffer or an environment."""

import subprocess
import sys

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_sap import KnowledgeBuffer, PermissibilityPredictor

OBSERVATIONS, ACTIONS = spaces.Box(-1, 1, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)


def knowledge_of(n):
    """K of n random actions, of which those that point away from the origin are not permissible."""
    rng = np.random.default_rng(0)
    obs, actions = rng.uniform(-1, 1, (n, 2)).astype(np.float32), rng.uniform(-1, 1, (n, 1)).astype(np.float32)
    knowledge = KnowledgeBuffer(OBSERVATIONS, action_dim=1, size=2 * n, seed=0)
    knowledge.add(obs, actions, obs[:, 0] * actions[:, 0] <= 0)
    return knowledge


def fitted_predictor(knowledge, fits=40):
    th.manual_seed(0)
    predictor = PermissibilityPredictor(OBSERVATIONS, ACTIONS, net_arch=[32], weight_decay=0.0, learning_rate=1e-2)
    for _ in range(fits):
        predictor.fit(knowledge.sample(256))
    return predictor


def test_predictor_learns_from_a_knowledge_buffer_without_an_algorithm():
    knowledge = knowledge_of(1_000)
    predictor = fitted_predictor(knowledge)
    assert min(predictor.recall(knowledge.sample(200, "validation"))) > 0.9


def test_loaded_predictor_gives_the_same_logits_and_keeps_its_settings(tmp_path):
    predictor = fitted_predictor(knowledge_of(200), fits=3)
    predictor.save(tmp_path / "predictor.pt")
    loaded = PermissibilityPredictor.load(tmp_path / "predictor.pt")
    obs, actions = th.rand(20, 2) * 2 - 1, th.rand(20, 1) * 2 - 1
    assert th.equal(loaded(obs, actions), predictor(obs, actions))
    assert loaded.fitted
    assert [group["lr"] for group in loaded.optimizer.param_groups] == [1e-2]
    assert loaded.batch_size == predictor.batch_size


def test_loaded_knowledge_buffer_holds_and_samples_the_same(tmp_path):
    knowledge = knowledge_of(200)
    knowledge.save(tmp_path / "knowledge.pkl")
    loaded = KnowledgeBuffer.load(tmp_path / "knowledge.pkl")
    assert loaded.counts("train") == knowledge.counts("train")
    one, other = knowledge.sample(50), loaded.sample(50)
    assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_file_without_a_knowledge_buffer_is_refused(tmp_path):
    from stable_baselines3.common.save_util import save_to_pkl

    save_to_pkl(tmp_path / "list.pkl", [1, 2])
    with pytest.raises(TypeError, match=r"holds no knowledge buffer but a list\.$"):
        KnowledgeBuffer.load(tmp_path / "list.pkl")


def test_predictor_and_knowledge_buffer_import_neither_replay_buffers_nor_algorithms():
    code = """if True:
        import sys, types
        package = types.ModuleType("sb3_sap")  # without its own imports
        package.__path__ = [sys.argv[1]]
        sys.modules["sb3_sap"] = package
        import sb3_sap.predictor.network, sb3_sap.predictor.knowledge
        print(*sorted(name for name in sys.modules if name.startswith("sb3_sap.")))
    """
    import sb3_sap

    command = [sys.executable, "-c", code, sb3_sap.__path__[0]]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    packages = {name.split(".")[1] for name in output}
    assert packages == {"common", "predictor"}
    assert not {"sb3_sap.predictor.buffers", "sb3_sap.predictor.mixin"} & set(output)
