"""Without guidance, each on-policy algorithm equals its base to the bit."""

import pytest
import torch as th
from gymnasium import spaces
from rollouts import (
    BASES,
    MULTI_BINARY,
    MULTI_DISCRETE,
    Recorder,
    assert_same_learning,
    build_on_policy,
    judged_by,
    permit,
)
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stubs import deny
from toy import Line

from sb3_sap import PPOAP


@pytest.mark.parametrize("env", [Line, lambda: Line(n_actions=3)], ids=["Box", "Discrete"])
@pytest.mark.parametrize(("algorithm", "base"), BASES.items(), ids=[algorithm.__name__ for algorithm in BASES])
def test_unguided_algorithm_equals_its_base_to_the_bit(algorithm, base, env):
    plain = build_on_policy(base, env()).learn(48)
    generator = th.get_rng_state()
    unguided = build_on_policy(algorithm, env(), alpha=0).learn(48)
    assert_same_learning(plain, unguided)
    assert th.equal(generator, th.get_rng_state())
    assert unguided.predictor.fitted


def test_unguided_model_of_four_normalised_environments_equals_its_base_to_the_bit():
    def env():
        return VecNormalize(DummyVecEnv([Line] * 4))

    plain, unguided = (build_on_policy(PPO, env()).learn(128), build_on_policy(PPOAP, env(), alpha=0).learn(128))
    assert_same_learning(plain, unguided)
    assert len(unguided.knowledge) == 128


@pytest.mark.parametrize("space", [spaces.Box(-1, 1, (2,)), spaces.Discrete(3), MULTI_DISCRETE, MULTI_BINARY], ids=str)
def test_where_everything_is_permitted_the_guided_model_equals_its_base_to_the_bit(space):
    plain = build_on_policy(PPO, Recorder(space)).learn(48)
    guided = judged_by(permit, PPOAP, Recorder(space)).learn(48)
    assert guided.predictor.queries
    assert_same_learning(plain, guided)


@pytest.mark.parametrize("space", [spaces.Discrete(3), MULTI_DISCRETE], ids=str)
def test_where_nothing_is_permitted_everything_is(space):
    plain = build_on_policy(PPO, Recorder(space)).learn(48)
    guided = judged_by(deny, PPOAP, Recorder(space)).learn(48)
    assert guided.predictor.queries
    assert_same_learning(plain, guided)


def test_same_seed_gives_the_same_bits_and_guidance_another_run():
    settings = {"permissibility_coef": 1.0, "penalty": "auto"}
    one, same = (build_on_policy(PPOAP, Line(n_actions=3), **settings).learn(160) for _ in range(2))
    assert one._rollout_guide is not None
    assert_same_learning(one, same)
    for name, value in one.predictor.state_dict().items():
        assert th.equal(value, same.predictor.state_dict()[name])
    unguided = build_on_policy(PPOAP, Line(n_actions=3), alpha=0).learn(160)
    assert not th.equal(one.policy.action_net.bias, unguided.policy.action_net.bias)
