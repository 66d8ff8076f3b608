"""E as an environment wrapper: labels, learning, replacing and penalising for agents of any library."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import Line

from sb3_sap import LearnedPermissibility

QUICK = {"predictor_kwargs": {"net_arch": [32], "learning_rate": 0.01}, "refit_growth": 0.02}


def nearer(obs, action, next_obs):
    return bool(abs(next_obs[0]) <= abs(obs[0]))


def play(env, steps, seed=0):
    """Random actions; returns what each step gave."""
    rng = np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    rows = []
    for _ in range(steps):
        action = rng.uniform(-1, 1, 1).astype(np.float32) if isinstance(env.action_space, gym.spaces.Box) else None
        action = int(rng.integers(env.action_space.n)) if action is None else action
        next_obs, reward, terminated, truncated, info = env.step(action)
        rows.append((obs, action, next_obs, reward, info))
        obs = env.reset()[0] if terminated or truncated else next_obs
    return rows


@pytest.mark.parametrize("line", [{}, {"n_actions": 3}])
def test_learned_predictor_replaces_mistakes(line):
    env = LearnedPermissibility(Line(labels=False, **line), nearer, alpha=1.0, seed=0, **QUICK)
    rows = play(env, 600)
    assert env.validation_accuracy > 0.7
    assert any(info["replaced"] for *_, info in rows)
    first, last = rows[:150], rows[-150:]
    mistakes = [np.mean([not info["permissible"] for *_, info in part]) for part in (first, last)]
    assert mistakes[1] < 0.5 * mistakes[0]
    for obs, action, next_obs, _, info in rows:
        assert info["permissible"] == nearer(obs, info["executed_action"], next_obs)
        assert info["replaced"] == (info["executed_action"] is not action)
        assert env.action_space.contains(info["executed_action"])


def test_penalty_is_for_mistakes_and_for_replaced_actions():
    env = LearnedPermissibility(Line(labels=False), nearer, penalty=5.0, alpha=1.0, seed=0, **QUICK)
    for _, _, next_obs, reward, info in play(env, 400):
        penalised = info["replaced"] or not info["permissible"]
        assert reward == pytest.approx(-abs(next_obs[0]) - 5.0 * penalised, abs=1e-5)


def test_without_alpha_nothing_is_replaced():
    env = LearnedPermissibility(Line(labels=False), nearer, penalty=0.0, alpha=0.0, seed=0)
    plain = play(Line(labels=False), 200)
    for one, other in zip(play(env, 200), plain, strict=True):
        assert np.array_equal(one[2], other[2])
        assert one[3] == other[3]


def test_same_seed_gives_the_same_actions():
    runs = [play(LearnedPermissibility(Line(labels=False), nearer, alpha=1.0, seed=3, **QUICK), 300) for _ in range(2)]
    for one, other in zip(*runs, strict=True):
        assert np.array_equal(one[4]["executed_action"], other[4]["executed_action"])


def test_plain_algorithm_of_stable_baselines3_learns_in_it():
    env = DummyVecEnv([lambda: LearnedPermissibility(Line(labels=False), nearer, seed=0)])
    model = SAC("MlpPolicy", env, seed=0, learning_starts=20, policy_kwargs={"net_arch": [8]}, batch_size=8)
    model.learn(120)
    assert env.envs[0].get_wrapper_attr("predictor").fitted


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"alpha": 2}, "^`alpha` is a probability from 0 to 1, but is 2"),
        ({"n_candidates": 0}, "^`n_candidates` must be a whole number of at least 1, but is 0"),
        ({"refit_growth": 1.0}, "^`refit_growth` is a fraction from 0 to below 1, but is 1.0"),
        ({"penalty": "much"}, "^`penalty` must be a number of at least 0"),
    ],
)
def test_bad_settings_get_a_sentence(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        LearnedPermissibility(Line(labels=False), nearer, **settings)


def test_unbounded_actions_are_refused():
    env = Line(labels=False)
    env.action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    with pytest.raises(ValueError, match=r"^LearnedPermissibility needs"):
        LearnedPermissibility(env, nearer)
