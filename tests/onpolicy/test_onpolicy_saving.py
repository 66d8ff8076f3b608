"""A saved model holds E and K; what it does next equals what the original does."""

import copy
import io
import pickle

import cloudpickle
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rollouts import BASES, Recorder, assert_same_learning, build_on_policy, even, judged_by
from stable_baselines3.common.policies import ActorCriticPolicy
from states import flat, reseed
from toy import Line

from sb3_sap import PPOAP, TRPOAP, GuidedPolicy


def knowledge_state(model):
    knowledge, filled = model.knowledge, model.knowledge._filled()
    rows = [knowledge.observations[""][filled], knowledge.actions[filled], knowledge.seen]
    return flat([*rows, knowledge.rng.bit_generator.state, float(model.labelled.reward_scale)])


@pytest.mark.parametrize("algorithm", BASES)
def test_loaded_model_continues_as_the_saved_one(algorithm, tmp_path):
    coef = 0.0 if algorithm is TRPOAP else 1.0
    model = build_on_policy(algorithm, Line(n_actions=3), permissibility_coef=coef, penalty="auto").learn(64)
    assert model.predictor.fitted
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", Line(n_actions=3))
    assert loaded.policy_class is model.policy_class
    assert loaded.validation_accuracy == model.validation_accuracy
    assert float(loaded.agreement) == float(model.agreement)
    for one in (model, loaded):
        reseed(one)
        if hasattr(one, "_last_lstm_states"):  # sb3-contrib leaves the memory out of files
            one._last_lstm_states = copy.deepcopy(loaded._last_lstm_states)
    before, after = knowledge_state(model), knowledge_state(loaded)
    assert before.keys() == after.keys()
    for name, value in before.items():
        np.testing.assert_array_equal(value, after[name], err_msg=name)
    for one in (model, loaded):
        reseed(one)
        one.learn(32, reset_num_timesteps=False)
    assert_same_learning(model, loaded)
    for name, value in model.predictor.state_dict().items():
        assert th.equal(value, loaded.predictor.state_dict()[name]), name


def test_loaded_model_predicts_without_an_environment():
    file = io.BytesIO()
    model = build_on_policy(PPOAP, Line(n_actions=3)).learn(64)
    model.save(file)
    loaded = PPOAP.load(file)
    obs = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    for guided in (False, None, True):
        expected = model.predict(obs, deterministic=True, guided=guided)[0]
        np.testing.assert_array_equal(loaded.predict(obs, deterministic=True, guided=guided)[0], expected)
    np.testing.assert_array_equal(GuidedPolicy(loaded).predict(obs, deterministic=True)[0], expected)
    with pytest.raises(ValueError, match=r"^This model has no environment to learn in"):
        loaded.learn(16)


def test_learning_rate_and_capacity_at_loading(tmp_path):
    build_on_policy(PPOAP).save(tmp_path / "model")
    assert PPOAP.load(tmp_path / "model", ent_coef=0.5).ent_coef == 0.5
    with pytest.raises(ValueError, match=r"^`knowledge_buffer_size` = 50 cannot be changed by `load`"):
        PPOAP.load(tmp_path / "model", knowledge_buffer_size=50)


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p)), lambda p: cloudpickle.loads(cloudpickle.dumps(p))],
)
def test_copied_policy_acts_as_the_original(copied):
    policy = build_on_policy(PPOAP).policy
    twin = copied(policy)
    assert type(twin) is type(policy)
    assert isinstance(twin, ActorCriticPolicy)
    obs = np.ones((5, 2), np.float32)
    np.testing.assert_array_equal(*(p.predict(obs, deterministic=True)[0] for p in (policy, twin)))


def test_policy_copied_amid_a_rollout_has_no_guide():
    copies = []

    def keep(local, _):
        policy = local["self"].policy
        assert policy.guide is not None
        copies.append(pickle.loads(pickle.dumps(policy)))
        return True

    judged_by(even, PPOAP, Recorder(spaces.Discrete(4))).learn(16, keep)
    assert len(copies) == 16
    assert all(policy.guide is None for policy in copies)


class Own(ActorCriticPolicy):
    """A policy with a forward pass of its own."""

    def forward(self, obs, deterministic=False):
        return th.zeros(len(obs)).long(), th.zeros(len(obs), 1), th.zeros(len(obs))


def test_policy_with_another_distribution_is_refused():
    model = PPOAP(Own, Recorder(spaces.Discrete(4)), n_steps=16, batch_size=16)
    model.predictor, model.validation_accuracy = judged_by(even, PPOAP).predictor, 1.0
    with pytest.raises(TypeError, match=r"^The policy Own does not make its action distribution with SB3's"):
        model.learn(16)
