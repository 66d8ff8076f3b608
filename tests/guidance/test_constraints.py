from functools import partial

import numpy as np
import pytest
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import CONSTRAINED, GUIDED, Line, build, nearby

from sb3_sap import DDPGCE1, DDPGCE2


class Spy:
    """A constraint that allows everything, or one interval, and remembers what it was asked."""

    def __init__(self, low=-np.inf, high=np.inf):
        self.interval = (low, high)
        self.asked = []

    def __call__(self, obs, previous_obs, last_action):
        self.asked.append((obs, previous_obs, last_action))
        return self.interval


def constrained(actor, constraint, previous, env=None):
    """A model whose actor answers ``actor`` in env units, past the warm-up."""
    model = build(DDPGCE1, env, constraint=constraint, learning_starts=0)
    model.predict = lambda obs, deterministic: (np.array(actor, np.float32), None)
    model._last_obs = np.zeros((len(actor), 2), np.float32)
    model._previous = previous
    model.set_logger(Logger(None, []))
    return model


BEFORE = (np.zeros(2, np.float32), np.zeros(1, np.float32))


def test_an_action_outside_is_replaced_by_a_uniform_draw_inside():
    model = constrained([[-0.75]] * 2000, Spy(0.25, 0.75), [BEFORE] * 2000)
    action, scaled = model._sample_action(0, None, 2000)
    np.testing.assert_allclose(action, scaled, atol=1e-6)
    assert scaled.min() >= 0.25
    assert scaled.max() <= 0.75
    counts, _ = np.histogram(scaled, bins=5, range=(0.25, 0.75))
    assert counts == pytest.approx([400] * 5, abs=72)  # 4 standard deviations


@pytest.mark.parametrize("inside", [0.25, 0.5, 0.75])
def test_an_action_inside_is_left_alone(inside):
    action, scaled = constrained([[inside]], Spy(0.25, 0.75), [BEFORE])._sample_action(0, None, 1)
    assert action == scaled == np.float32(inside)


def test_only_the_environments_outside_are_touched():
    model = constrained([[0.5], [-0.5], [0.5]], Spy(0.25, 0.75), [BEFORE, BEFORE, BEFORE])
    scaled = model._sample_action(0, None, 3)[1]
    assert scaled[0] == scaled[2] == 0.5
    assert 0.25 <= scaled[1] <= 0.75


def test_nothing_is_asked_on_an_environments_first_step():
    spy = Spy(0.25, 0.75)
    scaled = constrained([[-0.5], [-0.5]], spy, [None, BEFORE])._sample_action(0, None, 2)[1]
    assert scaled[0] == -0.5
    assert scaled[1] >= 0.25
    assert len(spy.asked) == 1


def test_with_two_dimensions_one_outside_replaces_the_whole_action():
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
def test_an_interval_beyond_the_action_space_is_cut(bound):
    scaled = constrained([[-0.5]] * 100, Spy(0.5, bound), [BEFORE] * 100)._sample_action(0, None, 100)[1]
    assert scaled.min() >= 0.5
    assert 0.9 < scaled.max() <= 1


@pytest.mark.parametrize("interval", [(0.5, 0.25), (np.nan, 1.0)])
def test_an_empty_interval_is_named(interval):
    with pytest.raises(ValueError, match=r"`constraint` must return \(low, high\) with low <= high, but gave"):
        constrained([[0.5]], Spy(*interval), [BEFORE])._sample_action(0, None, 1)


def test_noise_is_added_before_the_constraint_acts():
    model = constrained([[0.5]], Spy(0.25, 0.75), [BEFORE])
    assert 0.25 <= model._sample_action(0, lambda: np.float32([0.5]), 1)[1] <= 0.75


def test_the_uniform_warm_up_is_constrained_too():
    model = constrained([[0.5]], Spy(0.25, 0.75), [BEFORE])
    model.action_space.sample = lambda: np.float32([-1.0])
    assert 0.25 <= model._sample_action(10, None, 1)[1] <= 0.75


@pytest.mark.parametrize("normalise", [False, True], ids=["raw", "VecNormalize"])
@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_it_sees_raw_observations_and_the_executed_action_of_its_own_environment(algorithm, normalise):
    spy = Spy()
    inner = DummyVecEnv([partial(Line, low=2.0, high=10.0, horizon=horizon) for horizon in (4, 5)])
    env = VecNormalize(inner) if normalise else inner
    # Guidance asks again for the candidates: not here, so that each step asks once.
    unguided = {"alpha": 0.0} if algorithm in GUIDED else {}
    build(algorithm, env, constraint=spy, **unguided).learn(40)
    expected = []
    for t in range(20):  # vectorised steps
        for i, horizon in enumerate((4, 5)):
            step = t % horizon
            if step > 0:  # not on an episode's first step
                expected.append(((step - 1) / horizon, step / horizon, inner.envs[i].executed[t - 1].item()))
    asked = [(before[1], now[1], last.item()) for now, before, last in spy.asked]
    np.testing.assert_allclose(asked, expected, rtol=1e-5, atol=1e-6)
    # x_t = x_{t-1} + 0.1 · (a_{t-1} - 6) / 4
    moved = [now[0] - before[0] - 0.1 * (last.item() - 6) / 4 for now, before, last in spy.asked]
    np.testing.assert_allclose(moved, 0, atol=1e-5)


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_every_executed_action_obeys_the_constraint(algorithm):
    env = DummyVecEnv([lambda: Line(horizon=7)])
    model = build(algorithm, env).learn(70)
    actions = np.array(env.envs[0].executed).reshape(10, 7)
    assert np.abs(np.diff(actions, axis=1)).max() <= 0.5 + 1e-6
    assert np.abs(actions[1:, 0] - actions[:-1, -1]).max() > 0.5  # free on an episode's first step
    np.testing.assert_allclose(model.replay_buffer.actions[:70, 0, 0], actions.ravel(), atol=1e-6)


def test_dict_observations_are_handed_over_by_environment():
    spy = Spy()
    env = DummyVecEnv([partial(Line, "dict", horizon=horizon) for horizon in (4, 8)])
    build(DDPGCE2, env, policy="MultiInputPolicy", constraint=spy).learn(4)
    assert [(now["time"].item(), before["time"].item()) for now, before, _ in spy.asked] == [(0.25, 0), (0.125, 0)]


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_a_second_learn_starts_episodes_afresh(algorithm):
    spy = Spy()
    model = build(algorithm, Line(horizon=100), constraint=spy).learn(5)
    assert len(spy.asked) == 4
    model.learn(5)  # resets the environment
    assert len(spy.asked) == 8
    model.learn(5, reset_num_timesteps=False)  # goes on in the same episode
    assert len(spy.asked) == 13


def test_a_constraint_by_dotted_name():
    model = build(DDPGCE1, constraint="toy.nearby")
    assert model.constraint == "toy.nearby"
    assert model._constraint is nearby


@pytest.mark.parametrize("algorithm", [DDPGCE1, DDPGCE2])
def test_the_hand_made_baselines_build_no_predictor(algorithm):
    model = build(algorithm)
    assert not hasattr(model, "predictor")
    assert not hasattr(model.replay_buffer, "knowledge")


def test_draws_are_our_own_and_follow_the_seed():
    runs = []
    for seed in (1, 1, 2):
        model = constrained([[-0.75]] * 20, Spy(0.25, 0.75), [BEFORE] * 20)
        model.set_random_seed(seed)
        runs.append(model._sample_action(0, None, 20)[1])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
