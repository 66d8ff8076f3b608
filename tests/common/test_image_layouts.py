"""The user's functions get images in the environment's own layout, whichever the policy uses."""

import io

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)
from toy import build

from sb3_sap import DQNAP, SACAP


class Camera(gym.Env):
    """In channel 0, the pixel in row 1 and column 2 is 200 after a positive action; everything else is 0."""

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
    """An AP function, permissible actions and a constraint, which record the shapes of the images that they get."""

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
def test_functions_get_images_in_the_layout_of_the_environment(algorithm, keyed):
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


def test_loaded_model_keeps_the_layout_without_an_environment():
    shapes, file = Shapes(), io.BytesIO()
    pictures(DQNAP, Camera(), ap_function=Shapes().bright).learn(30).save(file)
    file.seek(0)
    loaded = DQNAP.load(file, permissible_actions=shapes.anything)
    loaded.predict(loaded.observation_space.sample(), guided=True)
    assert shapes.seen == {(36, 40, 3)}


@pytest.mark.parametrize("order", ["transposed, stacked", "stacked"])
def test_functions_get_stacked_frames_channels_last(order):
    shapes = Shapes()
    env = DummyVecEnv([Camera])
    env = VecFrameStack(VecTransposeImage(env), 4) if order.startswith("transposed") else VecFrameStack(env, 4)
    model = pictures(DQNAP, env, ap_function=lambda o, a, n: shapes.look(n)[:, 1, 2, 9] > 0).learn(30)
    assert shapes.seen == {(36, 40, 12)}
    assert min(model.replay_buffer.knowledge.seen) > 3


def test_functions_get_channels_first_images_unchanged():
    shapes = Shapes()
    pictures(DQNAP, Camera(channels_first=True), ap_function=lambda o, a, n: shapes.look(n)[:, 0, 1, 2] > 0).learn(20)
    assert shapes.seen == {(3, 36, 40)}


def test_images_beside_normalised_numbers_require_the_transposition_inside_vec_normalize():
    env = DummyVecEnv([lambda: Camera(keyed=True)])
    with pytest.raises(ValueError, match=r"VecNormalize\(VecTransposeImage\(env, ...\), ...\)"):
        pictures(DQNAP, VecNormalize(env, norm_obs_keys=["v"]), "MultiInputPolicy")
    shapes = Shapes()
    inside = VecNormalize(VecTransposeImage(env), norm_obs_keys=["v"])
    model = pictures(DQNAP, inside, "MultiInputPolicy", ap_function=shapes.bright).learn(30)
    assert shapes.seen == {(36, 40, 3)}
    assert min(model.replay_buffer.knowledge.seen) > 3
