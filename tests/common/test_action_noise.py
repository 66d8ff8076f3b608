"""Action noise: its description as in YAML, its dimension, and the number of environments."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import Line, build, towards_centre

from sb3_sap import DDPG, DDPGAP
from sb3_sap.common.action_noise import make_action_noise


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({"sigma": 0.1}, "`action_noise` has type None, but must be one of 'normal', 'ornstein-uhlenbeck'"),
        ({"type": "pink", "sigma": 0.1}, "`action_noise` has type 'pink', but must be one of"),
        ({"type": "normal"}, "`action_noise` needs 'sigma'"),
        ({"type": "normal", "sigma": 0.1, "theta": 0.6}, "`action_noise` of type 'normal': .*theta"),
    ],
)
@pytest.mark.parametrize("algorithm", [DDPG, DDPGAP])
def test_invalid_noise_descriptions_are_refused(algorithm, noise, message):
    with pytest.raises(ValueError, match=message):
        build(algorithm, action_noise=noise)


def test_described_noise_has_the_dimension_of_the_actions():
    space = spaces.Box(-1, 1, (3,))
    noise = make_action_noise({"type": "ornstein-uhlenbeck", "sigma": 0.3, "theta": 0.6, "dt": 1, "mean": 0.5}, space)
    assert (noise._theta, noise._dt) == (0.6, 1)
    np.testing.assert_array_equal(noise._mu, [0.5] * 3)
    np.testing.assert_array_equal(noise._sigma, [0.3] * 3)


def test_loaded_noise_of_four_environments_adapts_to_one_and_to_three(tmp_path):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    settings = {"action_noise": noise, "t_k": 1000, "ap_function": towards_centre}
    build(DDPGAP, DummyVecEnv([Line] * 4), **settings).learn(40).save(tmp_path / "model")
    for n in (1, 3):
        model = DDPGAP.load(tmp_path / "model", env=DummyVecEnv([Line] * n)).learn(30)
        assert model.replay_buffer.actions.shape[1:] == (n, 1)


@pytest.mark.parametrize("size", [2, 3])
def test_noise_of_another_dimension_is_refused(size):
    noise = NormalActionNoise(np.zeros(size), 0.1 * np.ones(size))
    with pytest.raises(ValueError, match=rf"^`action_noise` turned 1 actions of Box.*\(1, {size}\)"):
        build(DDPGAP, action_noise=noise, ap_function=towards_centre).learn(40)
