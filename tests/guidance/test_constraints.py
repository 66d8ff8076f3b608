"""Constraints on continuous actions: when they are applied, and to what."""

from functools import partial

import numpy as np
import pytest
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import CONSTRAINED, GUIDED, Line, build, nearby

from sb3_sap import DDPGCE1, DDPGCE2


class Spy:
    """A constraint that allows everything, or one interval, and records its calls."""

    def __init__(self, low=-np.inf, high=np.inf):
        self.interval = (low, high)
        self.calls = []

    def __call__(self, obs, previous_obs, last_action):
        self.calls.append((obs, previous_obs, last_action))
        return self.interval


def constrained(actor, constraint, previous, env=None):
    """A model past the warm-up whose actor always returns ``actor`` (env units)."""
    model = build(DDPGCE1, env, constraint=constraint, learning_starts=0)
    model.predict = lambda obs, deterministic: (np.array(actor, np.float32), None)
    model._last_obs = np.zeros((len(actor), 2), np.float32)
    model._previous = previous
    model.set_logger(Logger(None, []))
    return model


BEFORE = (np.zeros(2, np.float32), np.zeros(1, np.float32))


def test_action_outside_the_interval_is_replaced_by_a_uniform_draw_from_it():
    model = constrained([[-0.75]] * 2000, Spy(0.25, 0.75), [BEFORE] * 2000)
    action, scaled = model._sample_action(0, None, 2000)
    np.testing.assert_allclose(action, scaled, atol=1e-6)
    assert scaled.min() >= 0.25
    assert scaled.max() <= 0.75
    counts, _ = np.histogram(scaled, bins=5, range=(0.25, 0.75))
    assert counts == pytest.approx([400] * 5, abs=72)  # 4 standard deviations


@pytest.mark.parametrize("inside", [0.25, 0.5, 0.75])
def test_action_inside_the_interval_is_unchanged(inside):
    action, scaled = constrained([[inside]], Spy(0.25, 0.75), [BEFORE])._sample_action(0, None, 1)
    assert action == scaled == np.float32(inside)


def test_only_environments_with_an_action_outside_get_another_action():
    model = constrained([[0.5], [-0.5], [0.5]], Spy(0.25, 0.75), [BEFORE, BEFORE, BEFORE])
    scaled = model._sample_action(0, None, 3)[1]
    assert scaled[0] == scaled[2] == 0.5
    assert 0.25 <= scaled[1] <= 0.75


def test_constraint_is_not_applied_on_the_first_step_of_an_episode():
    spy = Spy(0.25, 0.75)
    scaled = constrained([[-0.5], [-0.5]], spy, [None, BEFORE])._sample_action(0, None, 2)[1]
    assert scaled[0] == -0.5
    assert scaled[1] >= 0.25
    assert len(spy.calls) == 1


def test_one_dimension_outside_replaces_the_whole_action():
    env = Line(dim=2)
    model = constrained([[0.5, -0.5], [0.5, 0.5]], Spy([0.0, 0.25], [1.0, 0.75]), [BEFORE] * 2, env)
    scaled = model._sample_action(0, None, 2)[1]
    assert scaled[0, 0] != 0.5
    assert 0.25 <= scaled[0, 1] <= 0.75
    np.testing.assert_array_equal(scaled[1], [0.5, 0.5])


def test_intervals_are_in_the_units_of_the_environment():
    # [2, 10]: the actor's 3 lies outside [4, 6], which is [-1/2, 0] scaled.
    model = constrained([[3]] * 100, Spy(4, 6), [BEFORE] * 100, Line(low=2.0, high=10.0))
    action, scaled = model._sample_action(0, None, 100)
    assert -0.5 <= scaled.min() < -0.45
    assert -0.05 < scaled.max() <= 0
    np.testing.assert_allclose(action, 6 + 4 * scaled, rtol=1e-6)


@pytest.mark.parametrize("bound", [5.0, np.inf])
def test_interval_beyond_the_action_space_is_clipped(bound):
    scaled = constrained([[-0.5]] * 100, Spy(0.5, bound), [BEFORE] * 100)._sample_action(0, None, 100)[1]
    assert scaled.min() >= 0.5
    assert 0.9 < scaled.max() <= 1


@pytest.mark.parametrize("interval", [(0.5, 0.25), (np.nan, 1.0)])
def test_empty_interval_is_refused(interval):
    with pytest.raises(ValueError, match=r"`constraint` must return \(low, high\) with low <= high, but gave"):
        constrained([[0.5]], Spy(*interval), [BEFORE])._sample_action(0, None, 1)


def test_noise_is_added_before_the_constraint_is_applied():
    model = constrained([[0.5]], Spy(0.25, 0.75), [BEFORE])
    assert 0.25 <= model._sample_action(0, lambda: np.float32([0.5]), 1)[1] <= 0.75


def test_uniform_warm_up_is_constrained():
    model = constrained([[0.5]], Spy(0.25, 0.75), [BEFORE])
    model.action_space.sample = lambda: np.float32([-1.0])
    assert 0.25 <= model._sample_action(10, None, 1)[1] <= 0.75


@pytest.mark.parametrize("normalise", [False, True], ids=["raw", "VecNormalize"])
@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_constraint_gets_raw_observations_and_the_executed_action_of_its_own_environment(algorithm, normalise):
    spy = Spy()
    inner = DummyVecEnv([partial(Line, low=2.0, high=10.0, horizon=horizon) for horizon in (4, 5)])
    env = VecNormalize(inner) if normalise else inner
    # Guidance would call the constraint again for its candidates; without it, each step calls it once.
    unguided = {"alpha": 0.0} if algorithm in GUIDED else {}
    build(algorithm, env, constraint=spy, **unguided).learn(40)
    expected = []
    for t in range(20):  # vectorised steps
        for i, horizon in enumerate((4, 5)):
            step = t % horizon
            if step > 0:  # not on an episode's first step
                expected.append(((step - 1) / horizon, step / horizon, inner.envs[i].executed[t - 1].item()))
    called = [(before[1], now[1], last.item()) for now, before, last in spy.calls]
    np.testing.assert_allclose(called, expected, rtol=1e-5, atol=1e-6)
    # x_t = x_{t-1} + 0.1 · (a_{t-1} - 6) / 4
    moved = [now[0] - before[0] - 0.1 * (last.item() - 6) / 4 for now, before, last in spy.calls]
    np.testing.assert_allclose(moved, 0, atol=1e-5)


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_executed_actions_obey_the_constraint(algorithm):
    env = DummyVecEnv([lambda: Line(horizon=7)])
    model = build(algorithm, env).learn(70)
    actions = np.array(env.envs[0].executed).reshape(10, 7)
    assert np.abs(np.diff(actions, axis=1)).max() <= 0.5 + 1e-6
    assert np.abs(actions[1:, 0] - actions[:-1, -1]).max() > 0.5  # free on an episode's first step
    np.testing.assert_allclose(model.replay_buffer.actions[:70, 0, 0], actions.ravel(), atol=1e-6)


def test_constraint_gets_the_dict_observations_of_one_environment():
    spy = Spy()
    env = DummyVecEnv([partial(Line, "dict", horizon=horizon) for horizon in (4, 8)])
    build(DDPGCE2, env, policy="MultiInputPolicy", constraint=spy).learn(4)
    assert [(now["time"].item(), before["time"].item()) for now, before, _ in spy.calls] == [(0.25, 0), (0.125, 0)]


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_second_learn_starts_a_new_episode_for_the_constraint(algorithm):
    spy = Spy()
    model = build(algorithm, Line(horizon=100), constraint=spy).learn(5)
    assert len(spy.calls) == 4
    model.learn(5)  # resets the environment
    assert len(spy.calls) == 8
    model.learn(5, reset_num_timesteps=False)  # continues in the same episode
    assert len(spy.calls) == 13


def test_constraint_given_by_dotted_name_is_resolved():
    model = build(DDPGCE1, constraint="toy.nearby")
    assert model.constraint == "toy.nearby"
    assert model._constraint is nearby


@pytest.mark.parametrize("algorithm", [DDPGCE1, DDPGCE2])
def test_constrained_ddpg_has_neither_predictor_nor_knowledge_buffer(algorithm):
    model = build(algorithm)
    assert not hasattr(model, "predictor")
    assert not hasattr(model.replay_buffer, "knowledge")


def test_draws_follow_the_seed_of_the_model():
    runs = []
    for seed in (1, 1, 2):
        model = constrained([[-0.75]] * 20, Spy(0.25, 0.75), [BEFORE] * 20)
        model.set_random_seed(seed)
        runs.append(model._sample_action(0, None, 20)[1])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
