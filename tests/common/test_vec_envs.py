"""What functions see behind SB3's wrappers: raw values, true last observations, the environment's own layout."""

import io

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
    unwrap_vec_normalize,
)
from toy import Line, build, towards_centre

from sb3_sap import DDPGAP, DQNAP, SACAP


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


def stood_still(obs, actions, next_obs):
    return (next_obs["still"] == obs["still"])[:, 0]


def vec(n=1, kind=DummyVecEnv, **settings):
    return kind([lambda: Count(**settings)] * n)


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64, np.float32, np.float64, np.float16])
def test_last_observations_under_vec_normalize_are_the_environments_own(dtype):
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
def test_entries_of_a_dict_that_stand_still_do_so_at_the_end_of_an_episode(settings):
    env = VecNormalize(vec(keyed=True), **settings)
    model = build(DDPGAP, env, policy="MultiInputPolicy", ap_function=stood_still, learning_starts=1000).learn(70)
    assert model.replay_buffer.knowledge.seen == [0, 70]
    buffer = model.replay_buffer
    np.testing.assert_array_equal(buffer.next_observations["still"][:70], buffer.observations["still"][:70])


@pytest.mark.slow
def test_last_observations_come_from_subprocesses_too():
    env = VecNormalize(vec(2, SubprocVecEnv, dtype=np.int64))
    model = build(DDPGAP, env, ap_function=went_up, learning_starts=1000).learn(140)
    env.close()
    assert model.replay_buffer.knowledge.seen == [0, 140]


def test_n_step_returns_get_the_last_observation_too():
    env = VecNormalize(vec(dtype=np.int64))
    model = build(DDPGAP, env, n_steps=3, ap_function=went_up, learning_starts=1000).learn(70)
    buffer = model.replay_buffer
    assert set((buffer.next_observations - buffer.observations)[:70].ravel()) == {1}


def test_beyond_the_clip_of_vec_normalize_labels_are_right():
    class Leap(Count):
        def observe(self):
            return super().observe() + np.float32(10_000 * (self.t == 7))

    env = VecNormalize(DummyVecEnv([Leap]), clip_obs=1.0)
    model = build(DDPGAP, env, ap_function=lambda o, a, n: n[:, 0] < 5_000, learning_starts=1000).learn(70)
    assert model.replay_buffer.knowledge.seen == [10, 60]


class KeepsLast(VecNormalize):
    """Leaves the raw last observation in info, for a base that shall store it."""

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


def test_unguided_under_vec_normalize_it_equals_a_base_that_stores_raw_last_observations():
    from test_exploration import assert_same_to_the_bit

    base = build(stable_baselines3.SAC, KeepsLast(DummyVecEnv([Line])), replay_buffer_class=StoresLast).learn(150)
    unguided = build(SACAP, VecNormalize(DummyVecEnv([Line])), alpha=0.0).learn(150)
    assert_same_to_the_bit(base, unguided)
    assert unguided.predictor.fitted


def test_the_environment_is_left_as_it_was():
    env = vec()
    own = env.step_wait = env.step_wait  # somebody else's
    build(DDPGAP, VecNormalize(env), ap_function=went_up).learn(20)
    assert vars(env)["step_wait"] is own
    assert "reset" not in vars(env)


def test_eval_callback_with_vec_normalize_goes_on_working():
    train, evaluation = VecNormalize(vec()), VecNormalize(vec(), training=False)
    callback = EvalCallback(evaluation, eval_freq=20, n_eval_episodes=1, verbose=0, warn=False)
    build(DDPGAP, train, ap_function=went_up).learn(41, callback=callback)
    assert evaluation.obs_rms.count == pytest.approx(41, abs=2)


# ---------------------------------------------------------------- layouts


class Camera(gym.Env):
    """The pixel in row 1, column 2 holds in channel 0 the last action, 0 or 200; the others tell where they are."""

    def __init__(self, discrete=True, keyed=False, channels_first=False):
        self.keyed, self.channels_first = keyed, channels_first
        shape = (3, 36, 40) if channels_first else (36, 40, 3)
        image = spaces.Box(0, 255, shape, np.uint8)
        number = spaces.Box(-1, 1, (1,), np.float32)
        self.observation_space = spaces.Dict({"image": image, "v": number}) if keyed else image
        self.action_space = spaces.Discrete(2) if discrete else number

    def observe(self, bright):
        image = np.zeros((36, 40, 3), np.uint8)
        image[1, 2, 0] = 200 * bright
        image = np.transpose(image, (2, 0, 1)) if self.channels_first else image
        return {"image": image, "v": np.zeros(1, np.float32)} if self.keyed else image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(False), {}

    def step(self, action):
        self.t += 1
        return self.observe(np.max(action) > 0), 0.0, False, self.t == 5, {}


class Shapes:
    """An AP function, or a rule, that remembers what it saw."""

    def __init__(self):
        self.seen = set()

    def look(self, obs):
        image = obs["image"] if isinstance(obs, dict) else obs
        self.seen.add(image.shape[1:])
        return image

    def bright(self, obs, actions, next_obs):
        self.look(obs)
        return self.look(next_obs)[:, 1, 2, 0] > 0

    def anything(self, obs, actions):
        self.look(obs)
        return np.ones(len(actions), bool)

    def interval(self, obs, previous, action):
        image = obs["image"] if isinstance(obs, dict) else obs
        before = previous["image"] if isinstance(previous, dict) else previous
        self.seen |= {image.shape, before.shape}
        return [-1.0], [1.0]


def pictures(algorithm, env, policy="CnnPolicy", **settings):
    extractor = CombinedExtractor if policy == "MultiInputPolicy" else FlattenExtractor
    policy_kwargs = {"net_arch": [8], "features_extractor_class": extractor}
    return build(algorithm, env, policy=policy, policy_kwargs=policy_kwargs, buffer_size=100, **settings)


@pytest.mark.parametrize("keyed", [False, True])
@pytest.mark.parametrize("algorithm", [DQNAP, SACAP])
def test_functions_see_images_as_the_environment_gives_them(algorithm, keyed):
    shapes = Shapes()
    env = Camera(discrete=algorithm is DQNAP, keyed=keyed)
    settings = {} if algorithm is DQNAP else {"constraint": shapes.interval}
    policy = "MultiInputPolicy" if keyed else "CnnPolicy"
    model = pictures(algorithm, env, policy, ap_function=shapes.bright, permissible_actions=shapes.anything, **settings)
    model.learn(40)
    assert min(model.replay_buffer.knowledge.seen) > 5
    assert sum(model.replay_buffer.knowledge.seen) == 40
    for obs in (env.observe(True), model.policy.observation_space.sample()):  # in either layout
        model.predict(obs, guided=True)
    assert shapes.seen == {(36, 40, 3)}


def test_a_loaded_model_knows_the_layout_without_an_environment():
    shapes, file = Shapes(), io.BytesIO()
    pictures(DQNAP, Camera(), ap_function=Shapes().bright).learn(30).save(file)
    file.seek(0)
    loaded = DQNAP.load(file, permissible_actions=shapes.anything)
    loaded.predict(loaded.observation_space.sample(), guided=True)
    assert shapes.seen == {(36, 40, 3)}


@pytest.mark.parametrize("order", ["transposed, stacked", "stacked"])
def test_frame_stacks_are_seen_channels_last(order):
    shapes = Shapes()
    env = DummyVecEnv([Camera])
    env = VecFrameStack(VecTransposeImage(env), 4) if order.startswith("transposed") else VecFrameStack(env, 4)
    model = pictures(DQNAP, env, ap_function=lambda o, a, n: shapes.look(n)[:, 1, 2, 9] > 0).learn(30)
    assert shapes.seen == {(36, 40, 12)}
    assert min(model.replay_buffer.knowledge.seen) > 3


def test_channels_first_stay_first():
    shapes = Shapes()
    pictures(DQNAP, Camera(channels_first=True), ap_function=lambda o, a, n: shapes.look(n)[:, 0, 1, 2] > 0).learn(20)
    assert shapes.seen == {(3, 36, 40)}


# ---------------------------------------------------------------- wrappers that cannot work


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda env: VecFrameStack(VecNormalize(env), 2), r"^`env` is wrapped in VecFrameStack on top of VecNormalize"),
        (lambda env: VecNormalize(VecNormalize(env)), "^`env` is wrapped in VecNormalize twice"),
    ],
)
def test_wrappers_in_an_order_that_mixes_raw_and_normalised(wrap, message):
    with pytest.raises(ValueError, match=message):
        build(DDPGAP, wrap(DummyVecEnv([Line])))
    build(DDPGAP, VecNormalize(VecFrameStack(DummyVecEnv([Line]), 2))).learn(30)


def test_images_beside_normalised_numbers_need_the_transposition_inside():
    env = DummyVecEnv([lambda: Camera(keyed=True)])
    with pytest.raises(ValueError, match=r"VecNormalize\(VecTransposeImage\(env, ...\), ...\)"):
        pictures(DQNAP, VecNormalize(env, norm_obs_keys=["v"]), "MultiInputPolicy")
    shapes = Shapes()
    inside = VecNormalize(VecTransposeImage(env), norm_obs_keys=["v"])
    model = pictures(DQNAP, inside, "MultiInputPolicy", ap_function=shapes.bright).learn(30)
    assert shapes.seen == {(36, 40, 3)}
    assert min(model.replay_buffer.knowledge.seen) > 3


# ---------------------------------------------------------------- somebody else in the training environment


class Evaluates(BaseCallback):
    def _on_step(self):
        if self.n_calls == 20:
            evaluate_policy(self.model, self.training_env, 1, warn=False)
        return True


@pytest.mark.filterwarnings("ignore:Training and eval env")
@pytest.mark.parametrize(
    "make",
    [
        lambda env: EvalCallback(env, eval_freq=20, verbose=0, warn=False),
        lambda env: [EveryNTimesteps(20, EvalCallback(env, verbose=0, warn=False))],
        lambda env: EvalCallback(env.envs[0], eval_freq=20, verbose=0, warn=False),
        lambda env: Evaluates(),
    ],
    ids=["EvalCallback", "nested", "the environment inside", "by itself"],
)
def test_evaluating_in_the_training_environment_warns(make):
    env = DummyVecEnv([Line])
    with pytest.warns(UserWarning, match="^The training environment is also used by .*environment of its own"):
        build(DDPGAP, env).learn(40, callback=make(env))


@pytest.mark.filterwarnings("error:The training environment")
def test_evaluating_in_another_environment_does_not_warn():
    env = DummyVecEnv([Line] * 2)
    callback = EvalCallback(DummyVecEnv([Line]), eval_freq=10, verbose=0, warn=False)
    model = build(DDPGAP, env).learn(40, callback=callback)
    model.learn(7, callback=lambda *_: False)  # stopped amid a step


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize], ids=["plain", "VecNormalize"])
@pytest.mark.parametrize("keyed", [False, True])
def test_learning_goes_on_right_after_an_evaluation_in_the_same_environment(wrap, keyed):
    policy = "MultiInputPolicy" if keyed else "MlpPolicy"
    model = build(DDPGAP, wrap(vec(2, keyed=keyed)), policy=policy, ap_function=went_up).learn(12)
    model.learn(12, reset_num_timesteps=False)
    assert model._episode_num == 2  # of seven steps: nobody was there, so nothing was reset
    evaluate_policy(model, model.get_env(), 1, warn=False)
    model.learn(40, reset_num_timesteps=False)
    assert model.replay_buffer.knowledge.seen == [0, 64]


class Skips(VecEnvWrapper):
    """Every action is executed twice."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        actions = self.venv.actions
        self.venv.step_wait()
        self.venv.step_async(actions)
        return self.venv.step_wait()


@pytest.mark.filterwarnings("error:The training environment")
@pytest.mark.parametrize("wrap", [Skips, lambda env: VecNormalize(Skips(env))])
def test_a_wrapper_that_steps_twice_is_nobody_else(wrap):
    build(DDPGAP, wrap(DummyVecEnv([Line]))).learn(40)


# ---------------------------------------------------------------- models that learned from normalised observations


def test_loading_into_an_environment_that_does_not_normalise_warns(tmp_path):
    model = build(DDPGAP, VecNormalize(DummyVecEnv([Line]))).learn(30)
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match=r"^This model learned from .* VecNormalize.load\(statistics, env\)"):
        DDPGAP.load(tmp_path / "model", env=Line())
    with pytest.warns(UserWarning, match="gives raw ones"):
        DDPGAP.load(tmp_path / "model").set_env(DummyVecEnv([Line]))
    with pytest.warns(UserWarning, match="statistics of this VecNormalize are those of no observation"):
        DDPGAP.load(tmp_path / "model", env=VecNormalize(DummyVecEnv([Line])))


@pytest.mark.filterwarnings("error:This model learned")
def test_loading_with_the_statistics_does_not_warn(tmp_path):
    model = build(DDPGAP, VecNormalize(DummyVecEnv([Line]))).learn(30)
    model.save(tmp_path / "model")
    unwrap_vec_normalize(model.env).save(tmp_path / "statistics.pkl")
    env = VecNormalize.load(tmp_path / "statistics.pkl", DummyVecEnv([Line]))
    DDPGAP.load(tmp_path / "model", env=env)
    rewards_alone = build(DDPGAP, VecNormalize(DummyVecEnv([Line]), norm_obs=False)).learn(30)
    rewards_alone.save(tmp_path / "model")
    DDPGAP.load(tmp_path / "model", env=Line())


# ---------------------------------------------------------------- other numbers of environments


def test_noise_of_four_environments_goes_on_with_one_and_with_three(tmp_path):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    settings = {"action_noise": noise, "t_k": 1000, "ap_function": towards_centre}
    build(DDPGAP, DummyVecEnv([Line] * 4), **settings).learn(40).save(tmp_path / "model")
    for n in (1, 3):
        model = DDPGAP.load(tmp_path / "model", env=DummyVecEnv([Line] * n)).learn(30)
        assert model.replay_buffer.actions.shape[1:] == (n, 1)


@pytest.mark.parametrize("size", [2, 3])
def test_noise_of_another_dimension_is_named(size):
    noise = NormalActionNoise(np.zeros(size), 0.1 * np.ones(size))
    with pytest.raises(ValueError, match=rf"^`action_noise` turned 1 actions of Box.*\(1, {size}\)"):
        build(DDPGAP, action_noise=noise, ap_function=towards_centre).learn(40)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: DummyVecEnv([Line] * 2), "replay buffer of 2 environments, but this model has 1"),
        (lambda: Line(high=3.0), r"whose action_space is Box\(-1.0, 3.0"),
        (lambda: gym.wrappers.FlattenObservation(Line("dict", n_actions=None)), None),
    ],
)
def test_a_replay_buffer_of_another_environment_is_refused_at_load(other, message):
    file = io.BytesIO()
    build(DDPGAP, other()).learn(20).save_replay_buffer(file)
    file.seek(0)
    model = build(DDPGAP)
    own = model.replay_buffer
    if message is None:  # equal spaces
        model.load_replay_buffer(file)
        return
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(file)
    assert model.replay_buffer is own
