"""A recurrent policy keeps its memory wherever it acts, and a controller needs none."""

import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import Line, build

from sb3_sap import SACAP, check_permissibility
from sb3_sap.benchmark import episodes
from sb3_sap.common.acting import Actor
from sb3_sap.evaluation.laps import drive


class Standing:
    """Remembers the position at which its episode began, and stays there: a lost memory is noticed at once."""

    def __init__(self):
        self.rows = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        obs = np.atleast_2d(observation)
        began = obs[:, 1] == 0
        first = obs[:, 0].copy() if state is None else state[0][0, :, 0]
        if episode_start is not None:
            assert np.array_equal(episode_start, began)
        first = np.where(began, obs[:, 0], first)
        assert np.array_equal(first, obs[:, 0])
        self.rows.append(len(obs))
        return np.zeros((*np.shape(observation)[:-1], 1), dtype=np.float32), (first[None, :, None],)


def test_memory_of_recurrent_ppo_is_the_one_of_its_own_predict():
    model = RecurrentPPO("MlpLstmPolicy", DummyVecEnv([Line]), n_steps=8, seed=1)
    observations = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    act, state, forgetful = Actor(model), None, []
    for i, obs in enumerate(observations):
        expected, state = model.predict(obs, state=state, episode_start=np.array([i == 0]), deterministic=True)
        assert np.array_equal(act(obs), expected)
        forgetful.append(np.array_equal(model.predict(obs, deterministic=True)[0], expected))
    assert not all(forgetful)


def test_a_start_forgets_what_was_before():
    model = RecurrentPPO("MlpLstmPolicy", DummyVecEnv([Line]), n_steps=8, seed=1)
    obs, act = np.ones(2, dtype=np.float32), Actor(model)
    first = act(obs)
    assert not np.array_equal(act(obs), first)
    assert np.array_equal(act(obs, True), first)


def test_rows_of_a_batch_that_end_are_forgotten(monkeypatch):
    monkeypatch.setattr(episodes, "entry", lambda *_: {})
    horizons = iter((2, 5, 3))
    monkeypatch.setattr(episodes, "make_env", lambda *_, **__: Line(horizon=next(horizons)))
    policy = Standing()
    rows = episodes.evaluation("Line", "ppo_lstm_ap", {}, ["1", "2", "3"])(policy)
    assert [row[-1] for row in rows] == [2, 5, 3]
    assert policy.rows == [3, 3, 2, 1, 1]


def test_an_episode_that_is_driven_keeps_it():
    policy = Standing()
    assert len(list(drive(policy, Line(horizon=4)))) == 4


def test_check_begins_anew_with_each_episode():
    policy = Standing()
    check_permissibility(Line(), policy=policy, n_steps=100, verbose=False)
    assert len(policy.rows) == 100


@pytest.mark.parametrize("n_envs", [1, 2])
def test_guide_keeps_it_from_learn_to_learn(n_envs):
    guide = Standing()
    model = build(SACAP, DummyVecEnv([Line] * n_envs), guide_policy=guide, learning_starts=1000)
    model.learn(24)
    model.learn(12, reset_num_timesteps=False)
    assert guide.rows == [n_envs] * (36 // n_envs)


def test_guide_is_saved_without_its_memory(tmp_path):
    model = build(SACAP, guide_policy=Standing(), learning_starts=1000).learn(5)
    model.save(tmp_path / "model")
    assert SACAP.load(tmp_path / "model", env=DummyVecEnv([Line]))._guide is None
