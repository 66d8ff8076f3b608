"""Behind SB3's wrappers, the user's functions get raw values and the true last observations of episodes."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecNormalize,
)
from toy import Line, build

from sb3_sap import DDPGAP


class Count(gym.Env):
    """Counts 0.1, 0.2, ... in the space's type, or 1, 2, ... in whole numbers; every episode takes 7 steps."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, dtype=np.float32, keyed=False, top=1000):
        number = spaces.Box(0, top, (1,), dtype)
        self.dtype, self.keyed = dtype, keyed
        self.unit = 1 if np.issubdtype(dtype, np.integer) else 0.1
        self.observation_space = spaces.Dict({"n": number, "still": number}) if keyed else number

    def observe(self):
        n = np.array([self.n * self.unit], self.dtype)
        return {"n": n, "still": np.full_like(n, 3.3)} if self.keyed else n

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n, self.t = int(self.np_random.integers(50)), 0
        return self.observe(), {}

    def step(self, action):
        self.n, self.t = self.n + 1, self.t + 1
        return self.observe(), 0.0, False, self.t == 7, {}


def went_up(obs, actions, next_obs):
    before, after = (o["n"] if isinstance(o, dict) else o for o in (obs, next_obs))
    return (after.astype(float) - before.astype(float))[:, 0] > 0


def is_constant(obs, actions, next_obs):
    return (next_obs["still"] == obs["still"])[:, 0]


def vec(n=1, kind=DummyVecEnv, **settings):
    return kind([lambda: Count(**settings)] * n)


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64, np.float32, np.float64, np.float16])
def test_last_observations_under_vec_normalize_are_those_of_the_environment(dtype):
    top = 255 if dtype == np.uint8 else 1000
    seen = []

    def exact(obs, actions, next_obs):
        seen.append((obs.copy(), next_obs.copy()))
        return went_up(obs, actions, next_obs)

    model = build(DDPGAP, VecNormalize(vec(2, dtype=dtype, top=top)), ap_function=exact, learning_starts=1000)
    model.learn(140)
    assert model.replay_buffer.knowledge.seen == [0, 140]
    assert {o.dtype for pair in seen for o in pair} == {np.dtype(dtype)}
    plain = build(DDPGAP, vec(2, dtype=dtype, top=top), ap_function=went_up, learning_starts=1000).learn(140)
    for name in ("observations", "next_observations"):
        np.testing.assert_array_equal(getattr(model.replay_buffer, name), getattr(plain.replay_buffer, name))


@pytest.mark.parametrize("settings", [{}, {"norm_obs_keys": ["n"]}, {"norm_obs": False}], ids=str)
def test_constant_dict_entries_are_constant_at_the_end_of_an_episode(settings):
    env = VecNormalize(vec(keyed=True), **settings)
    model = build(DDPGAP, env, policy="MultiInputPolicy", ap_function=is_constant, learning_starts=1000).learn(70)
    assert model.replay_buffer.knowledge.seen == [0, 70]
    buffer = model.replay_buffer
    np.testing.assert_array_equal(buffer.next_observations["still"][:70], buffer.observations["still"][:70])


@pytest.mark.slow
def test_last_observations_of_subprocesses_are_raw():
    env = VecNormalize(vec(2, SubprocVecEnv, dtype=np.int64))
    model = build(DDPGAP, env, ap_function=went_up, learning_starts=1000).learn(140)
    env.close()
    assert model.replay_buffer.knowledge.seen == [0, 140]


def test_n_step_buffer_stores_raw_last_observations():
    env = VecNormalize(vec(dtype=np.int64))
    model = build(DDPGAP, env, n_steps=3, ap_function=went_up, learning_starts=1000).learn(70)
    buffer = model.replay_buffer
    assert set((buffer.next_observations - buffer.observations)[:70].ravel()) == {1}


def test_labels_are_right_beyond_the_clip_of_vec_normalize():
    class Leap(Count):
        def observe(self):
            return super().observe() + np.float32(10_000 * (self.t == 7))

    env = VecNormalize(DummyVecEnv([Leap]), clip_obs=1.0)
    model = build(DDPGAP, env, ap_function=lambda o, a, n: n[:, 0] < 5_000, learning_starts=1000).learn(70)
    assert model.replay_buffer.knowledge.seen == [10, 60]


def test_learning_leaves_the_methods_of_the_environment_as_they_were():
    env = vec()
    own = env.step_wait = env.step_wait  # as another library may have set it
    build(DDPGAP, VecNormalize(env), ap_function=went_up).learn(20)
    assert vars(env)["step_wait"] is own
    assert "reset" not in vars(env)


def test_eval_callback_synchronises_vec_normalize_as_before():
    train, evaluation = VecNormalize(vec()), VecNormalize(vec(), training=False)
    callback = EvalCallback(evaluation, eval_freq=20, n_eval_episodes=1, verbose=0, warn=False)
    build(DDPGAP, train, ap_function=went_up).learn(41, callback=callback)
    assert evaluation.obs_rms.count == pytest.approx(41, abs=2)


# ---------------------------------------------------------------- orders of wrappers, and evaluations in between


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda env: VecFrameStack(VecNormalize(env), 2), r"^`env` is wrapped in VecFrameStack on top of VecNormalize"),
        (lambda env: VecNormalize(VecNormalize(env)), "^`env` is wrapped in VecNormalize twice"),
    ],
)
def test_wrapper_orders_that_mix_raw_and_normalised_observations_are_refused(wrap, message):
    with pytest.raises(ValueError, match=message):
        build(DDPGAP, wrap(DummyVecEnv([Line])))
    build(DDPGAP, VecNormalize(VecFrameStack(DummyVecEnv([Line]), 2))).learn(30)


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize], ids=["plain", "VecNormalize"])
@pytest.mark.parametrize("keyed", [False, True])
def test_learning_continues_correctly_after_an_evaluation_in_the_same_environment(wrap, keyed):
    policy = "MultiInputPolicy" if keyed else "MlpPolicy"
    model = build(DDPGAP, wrap(vec(2, keyed=keyed)), policy=policy, ap_function=went_up).learn(12)
    model.learn(12, reset_num_timesteps=False)
    assert (
        model._episode_num == 2
    )  # of seven steps each: the environment was not used in between, and therefore not reset
    evaluate_policy(model, model.get_env(), 1, warn=False)
    model.learn(40, reset_num_timesteps=False)
    assert model.replay_buffer.knowledge.seen == [0, 64]
