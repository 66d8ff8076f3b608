"""Without guidance, each algorithm equals its base to the bit; the same seed gives the same bits."""

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stubs import Constant
from toy import GUIDED, Line, build

from sb3_sap import DDPG, DDPGAP, SACAP, TD3AP, TQCAP, CrossQAP


def tensors(model):
    """All tensors that a model has learned, by name."""
    found = {}
    for name, state in model.get_parameters().items():
        if name.startswith("predictor"):
            continue
        if "optimizer" in name:
            for index, entry in state["state"].items():
                found |= {f"{name}.{index}.{key}": value for key, value in entry.items()}
        else:
            found |= {f"{name}.{key}": value for key, value in state.items()}
    return found


def assert_same_to_the_bit(one, other):
    states = tensors(one), tensors(other)
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        assert th.equal(value, states[1][name]), name
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        a, b = (getattr(m.replay_buffer, name) for m in (one, other))
        np.testing.assert_array_equal(a, b, err_msg=name)


def three():
    return DummyVecEnv([Line] * 3)


@pytest.mark.parametrize("make_env", [Line, three], ids=["one", "three"])
@pytest.mark.parametrize("algorithm", [DDPG, DDPGAP])
def test_unguided_ddpg_equals_that_of_sb3_to_the_bit(algorithm, make_env):
    def noise():
        return NormalActionNoise(np.zeros(1), 0.3 * np.ones(1))

    runs, torch_states = [], []
    for cls in (stable_baselines3.DDPG, algorithm):
        extra = {"alpha": 0.0} if cls is DDPGAP else {}
        runs.append(build(cls, make_env(), action_noise=noise(), **extra).learn(150))
        torch_states.append(th.get_rng_state())
    assert_same_to_the_bit(*runs)
    # The targets of DDPG have no noise, so that no weight depends on torch's generator, as it would elsewhere.
    assert th.equal(*torch_states)
    if algorithm is DDPGAP:
        assert runs[1].predictor.fitted


BASES = {
    TD3AP: stable_baselines3.TD3,
    SACAP: stable_baselines3.SAC,
    TQCAP: sb3_contrib.TQC,
    CrossQAP: sb3_contrib.CrossQ,
}


@pytest.mark.parametrize(("algorithm", "base"), BASES.items(), ids=[algorithm.__name__ for algorithm in BASES])
def test_unguided_algorithm_equals_its_base_to_the_bit(algorithm, base):
    plain = build(base).learn(150)
    unguided = build(algorithm, alpha=0.0, t_k=10).learn(150)
    assert_same_to_the_bit(plain, unguided)
    assert unguided.predictor.fitted


@pytest.mark.parametrize(
    "algorithm", [pytest.param(cls, marks=pytest.mark.slow if cls not in (DDPGAP, SACAP) else ()) for cls in GUIDED]
)
def test_same_seed_gives_the_same_bits_and_guidance_other_actions(algorithm):
    settings = {"alpha_low": 0.9, "action_noise": Constant(0.0)}
    one, same = (build(algorithm, **settings).learn(150) for _ in range(2))
    assert_same_to_the_bit(one, same)
    for name, value in one.predictor.state_dict().items():
        assert th.equal(value, same.predictor.state_dict()[name])
    unguided = build(algorithm, **(settings | {"alpha": 0.0})).learn(150)
    assert not np.array_equal(one.replay_buffer.actions, unguided.replay_buffer.actions)
    other = build(algorithm, seed=2, **settings).learn(150)
    assert not np.array_equal(one.replay_buffer.actions, other.replay_buffer.actions)


class KeepsLast(VecNormalize):
    """Puts the raw last observation of an episode into info, for a base that stores it."""

    def step_wait(self):
        step_wait, lasts = self.venv.step_wait, {}

        def remember():
            result = step_wait()
            lasts.update({i: info.get("terminal_observation") for i, info in enumerate(result[3])})
            return result

        self.venv.step_wait = remember
        try:
            result = super().step_wait()
        finally:
            del self.venv.step_wait
        for i, info in enumerate(result[3]):
            info["last"] = lasts[i]
        return result


class StoresLast(ReplayBuffer):
    def add(self, obs, next_obs, action, reward, done, infos):
        for i, info in enumerate(infos):
            if done[i]:
                next_obs[i] = info["last"]
        super().add(obs, next_obs, action, reward, done, infos)


def test_unguided_model_under_vec_normalize_equals_a_base_that_stores_raw_last_observations():
    base = build(stable_baselines3.SAC, KeepsLast(DummyVecEnv([Line])), replay_buffer_class=StoresLast).learn(150)
    unguided = build(SACAP, VecNormalize(DummyVecEnv([Line])), alpha=0.0).learn(150)
    assert_same_to_the_bit(base, unguided)
    assert unguided.predictor.fitted
