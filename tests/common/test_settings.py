"""Every mistake gets one sentence that names the argument and what was expected, before training is lost."""

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from toy import ALGORITHMS, CONSTRAINED, GUIDED, Line, build

from sb3_sap import (
    DDPG,
    DDPGAP,
    DQNAP,
    SACAP,
    ActionPermissibility,
    ActionPermissibilityMixin,
    ConstrainedExplorationMixin,
)
from sb3_sap.common.action_noise import make_action_noise
from sb3_sap.common.spaces import check_action_space

F32 = np.finfo(np.float32)


class RuledDQN(ConstrainedExplorationMixin, stable_baselines3.DQN):
    pass


def with_actions(space):
    env = Line()
    env.action_space = space
    return env


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)], ids=lambda s: type(s).__name__
)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_action_space_must_be_continuous(algorithm, space):
    with pytest.raises(
        ValueError, match=rf"^{algorithm.__name__} needs an `env` with a continuous \(Box\) action space"
    ):
        build(algorithm, with_actions(space))


def test_an_environment_by_name_is_checked_too():
    with pytest.raises(ValueError, match=r"^DDPGAP needs an `env` with a continuous .*but this one's is Discrete"):
        DDPGAP("MlpPolicy", "CartPole-v1")


@pytest.mark.parametrize("low", [-1.0, -np.inf])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_action_space_must_be_bounded(algorithm, low):
    with pytest.raises(ValueError, match=rf"^{algorithm.__name__} needs an `env` whose actions are bounded.*inf"):
        build(algorithm, with_actions(spaces.Box(low, np.inf, (1,))))


@pytest.mark.parametrize("algorithm", GUIDED)
def test_no_ap_function_anywhere(algorithm):
    model = build(algorithm, Line(labels=False))
    with pytest.raises(ValueError, match=r"^There is no AP function: .* Pass `ap_function=`"):
        model.learn(100)
    assert model.num_timesteps == 1


def returns(value):
    return lambda obs, actions, next_obs: value


@pytest.mark.parametrize(
    ("ap_function", "error", "message"),
    [
        (lambda obs, actions, next_obs: 1 / 0, RuntimeError, "^`ap_function` <lambda> raised ZeroDivisionError"),
        (lambda obs, action: True, RuntimeError, "^`ap_function` <lambda> raised TypeError.*batches"),
        (
            returns(np.array([[True]])),
            ValueError,
            r"returned an array of shape \(1, 1\) for 1 actions, but must .*\(1,\)",
        ),
        (returns(True), ValueError, r"returned an array of shape \(\) for 1 actions, but must return shape \(1,\)"),
        (returns(np.array([1])), TypeError, "returned values of type int64, but must return bool"),
        (returns(np.array([np.nan])), TypeError, "returned NaN, but must return bool"),
        (returns(None), TypeError, "returned values of type object, but must return bool"),
    ],
)
@pytest.mark.parametrize("algorithm", GUIDED)
def test_ap_function_that_does_not_label(algorithm, ap_function, error, message):
    model = build(algorithm, ap_function=ap_function)
    with pytest.raises(error, match=message):
        model.learn(100)
    assert model.num_timesteps == 1


@pytest.mark.parametrize("name", ["no_module.f", "toy.missing", "missing", 3])
def test_ap_function_that_cannot_be_found_fails_in_the_constructor(name):
    with pytest.raises((TypeError, ValueError), match=r"^`ap_function`"):
        build(DDPGAP, ap_function=name)


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_constraint_that_cannot_be_found_fails_in_the_constructor(algorithm):
    with pytest.raises(ValueError, match=r"^`constraint`: 'toy\.missing' cannot be imported"):
        build(algorithm, constraint="toy.missing")


def test_a_wrapper_that_labels_with_numbers():
    with pytest.raises(TypeError, match=r'^`info\["permissible"\]` must be a bool, but is 1\.$'):
        build(DDPGAP, ActionPermissibility(Line(), lambda obs, action, next_obs: 1)).learn(100)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"alpha": 1.1}, "^`alpha` is a probability from 0 to 1, but is 1.1"),
        ({"alpha": -0.1}, "^`alpha` is a probability from 0 to 1, but is -0.1"),
        ({"alpha": float("nan")}, "^`alpha` is a probability from 0 to 1, but is nan"),
        ({"alpha_low": 2}, "^`alpha_low` is a probability from 0 to 1, but is 2"),
        ({"alpha": "much"}, "^`alpha` is a probability from 0 to 1, but is 'much'"),
        ({"t_k": -1}, "^`t_k` must be a whole number of at least 0, but is -1"),
        ({"t_k": "100"}, "^`t_k` must be a whole number of at least 0, but is '100'"),
        ({"refit_growth": "0.1"}, "^`refit_growth` is a fraction from 0 to below 1, but is '0.1'"),
        (
            {"knowledge_buffer_size": 1e4},
            "^`knowledge_buffer_size` must be a whole number of at least 4, but is 10000.0",
        ),
        ({"n_candidates": 0}, "^`n_candidates` must be a whole number of at least 1, but is 0"),
        ({"refit_growth": 1.0}, "^`refit_growth` is a fraction from 0 to below 1, but is 1.0"),
        ({"teaching_growth": 1}, "^`teaching_growth` is a fraction from 0 to below 1, but is 1"),
        ({"refit_growth": -0.1}, "^`refit_growth` is a fraction from 0 to below 1, but is -0.1"),
        ({"min_per_class": 0}, "^`min_per_class` must be a whole number of at least 1, but is 0"),
        ({"dataset_size": 1}, "^`dataset_size` must be a whole number of at least 2, but is 1"),
        ({"validation_size": 0}, "^`validation_size` must be a whole number of at least 2, but is 0"),
        ({"knowledge_buffer_size": 0}, "`knowledge_buffer_size` must be a whole number of at least 4, but is 0"),
        ({"knowledge_buffer_size": -1}, "`knowledge_buffer_size` must be a whole number of at least 4, but is -1"),
        (
            {"knowledge_buffer_size": 14},
            "^`knowledge_buffer_size` = 14 with `validation_fraction` = 0.1 leaves no room",
        ),
        (
            {"knowledge_buffer_size": 100, "min_per_class": 46},
            "^`min_per_class` = 46 can never be reached.*room for 45",
        ),
        ({"validation_fraction": 0.0}, "^`validation_fraction` must lie between 0 and 1, but is 0.0"),
        ({"validation_fraction": 1.0}, "^`validation_fraction` must lie between 0 and 1, but is 1.0"),
        ({"validation_fraction": 1.5}, "^`validation_fraction` must lie between 0 and 1, but is 1.5"),
        ({"predictor_kwargs": {"optimizer_class": "Sgd"}}, "^`optimizer_class` = 'Sgd' names no optimizer"),
    ],
    ids=str,
)
@pytest.mark.parametrize("algorithm", GUIDED)
def test_settings_that_cannot_work_fail_in_the_constructor(algorithm, settings, message):
    with pytest.raises(ValueError, match=message):
        build(algorithm, **settings)


def test_unknown_arguments_of_the_predictor_are_named():
    with pytest.raises(TypeError, match=r"^`predictor_kwargs` holds 'layers', but .* takes net_arch, activation_fn"):
        build(DDPGAP, predictor_kwargs={"layers": [64]})


def test_the_smallest_settings_that_can_work():
    build(
        DDPGAP, alpha=0, alpha_low=1, t_k=0, n_candidates=1, min_per_class=1, dataset_size=2, validation_size=2
    ).learn(60)
    build(DDPGAP, knowledge_buffer_size=100, min_per_class=45)
    build(DDPGAP, knowledge_buffer_size=16, min_per_class=7).learn(60)


@pytest.mark.parametrize("algorithm", [algorithm for algorithm in GUIDED if not algorithm.stochastic_policy])
def test_t_k_beyond_the_warm_up_without_noise_warns(algorithm):
    with pytest.warns(
        UserWarning, match="^`t_k` = 11 is beyond `learning_starts` = 10, but there is no `action_noise`"
    ):
        build(algorithm, t_k=11)


def test_an_end_of_guidance_before_its_beginning_warns():
    with pytest.warns(UserWarning, match="^`guidance_end` = 10 leaves no step to guidance, which begins after 10"):
        build(DDPGAP, guidance_end=10)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "settings", [{"guidance_end": 11}, {"t_k": 10}, {"t_k": 11, "action_noise": {"type": "normal", "sigma": 0.1}}]
)
def test_no_warning_where_the_policy_explores(settings):
    build(DDPGAP, **settings)
    build(SACAP, t_k=11)


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
def test_noise_descriptions(algorithm, noise, message):
    with pytest.raises(ValueError, match=message):
        build(algorithm, action_noise=noise)


def test_noise_of_a_description_has_the_dimension_of_the_actions():
    space = spaces.Box(-1, 1, (3,))
    noise = make_action_noise({"type": "ornstein-uhlenbeck", "sigma": 0.3, "theta": 0.6, "dt": 1, "mean": 0.5}, space)
    assert (noise._theta, noise._dt) == (0.6, 1)
    np.testing.assert_array_equal(noise._mu, [0.5] * 3)
    np.testing.assert_array_equal(noise._sigma, [0.3] * 3)


def test_unknown_arguments_are_refused():
    with pytest.raises(TypeError, match="alhpa"):
        build(DDPGAP, alhpa=0.5)


def test_an_environment_that_does_not_exist():
    with pytest.raises(gym.error.Error, match="NoSuchEnvironment"):
        DDPGAP("MlpPolicy", "NoSuchEnvironment-v0")


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(-10, 10, (1,), np.int32), "floating-point numbers.*truncated to whole numbers"),
        (spaces.Box(0, 255, (2,), np.uint8), "floating-point numbers"),
        (spaces.Box(-F32.max, F32.max, (1,), np.float32), r"scaled to \[-1, 1\] and back.*too large"),
        (spaces.Box(np.float32([-1, -3e38]), np.float32([1, 3e38])), "scaled to"),
        (spaces.Box(1e8, 1e8 + 16, (1,), np.float32), "too close together"),
        (spaces.Box(-1e308, 1e308, (1,), np.float64), "scaled to"),
        (spaces.Box(0, 60_000, (1,), np.float16), None),
        (spaces.Box(-60_000, 60_000, (1,), np.float16), "scaled to"),
        (spaces.Box(np.float32([-1, 2]), np.float32([1, 2])), "can vary.*leave out the dimensions that are fixed"),
        (spaces.Box(-F32.max / 4, F32.max / 4, (1,), np.float32), None),
        (spaces.Box(-1, 1, (), np.float32), None),
        (spaces.Box(0, 1e-6, (2, 2), np.float32), None),
        (spaces.Box(-1e30, 1e30, (1,), np.float64), None),
    ],
    ids=str,
)
def test_action_spaces_that_cannot_be_scaled(space, message):
    if message is None:
        check_action_space("DDPGAP", space, discrete=False)
        return
    for algorithm in (DDPG, SACAP):
        with pytest.raises(ValueError, match=f"^{algorithm.__name__} needs an `env` whose actions {message}|{message}"):
            build(algorithm, with_actions(space))


def with_observations(space):
    env = Line(n_actions=2)
    env.observation_space = space
    return env


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (with_actions(spaces.Discrete(3, start=-1)), r"actions that count from 0.*lambda a: a \+ -1.*Discrete\(3\)"),
        (with_actions(spaces.MultiDiscrete([2, 2])), "no off-policy algorithm of SB3 takes it"),
        (with_actions(spaces.MultiBinary(3)), "no off-policy algorithm of SB3 takes it"),
        (with_actions(spaces.Box(-1, 1, (1,))), r"discrete \(Discrete\).*such as SACAP"),
        (with_observations(spaces.Discrete(4, start=1)), "observations count from 0.*subtract `start`"),
        (with_observations(spaces.MultiDiscrete([3, 3], start=[0, 1])), "observations count from 0"),
        (with_observations(spaces.Dict(a=spaces.Discrete(4, start=1))), "the entry 'a' of its observation space"),
        (with_observations(spaces.Tuple([spaces.Discrete(4)])), "FlattenObservation"),
        (with_observations(spaces.Dict(a=spaces.Dict(b=spaces.Discrete(4)))), "the entry 'a'.*FlattenObservation"),
        (with_observations(spaces.Text(4)), "FlattenObservation"),
    ],
    ids=str,
)
@pytest.mark.parametrize("algorithm", [DQNAP, RuledDQN])
def test_spaces_that_discrete_actions_and_sb3_cannot_use(algorithm, env, message):
    with pytest.raises(ValueError, match=f"^{algorithm.__name__} needs .*{message}"):
        build(algorithm, env)


def test_the_shift_that_the_sentence_names_works():
    env = with_actions(spaces.Discrete(3, start=-1))
    env.step = lambda a: executed.append(int(a)) or (np.zeros(2, np.float32), 0.0, False, False, {"permissible": a > 0})
    executed = []
    build(DQNAP, gym.wrappers.TransformAction(env, lambda a: a + -1, spaces.Discrete(3))).learn(40)
    assert set(executed) == {-1, 0, 1}


@pytest.mark.parametrize("base", [stable_baselines3.PPO, stable_baselines3.A2C, sb3_contrib.TRPO])
@pytest.mark.parametrize("mixin", [ActionPermissibilityMixin, ConstrainedExplorationMixin])
def test_a_mixin_before_an_on_policy_algorithm(mixin, base):
    with pytest.raises(TypeError, match=f"^Mine puts {mixin.__name__} before an on-policy algorithm"):
        type("Mine", (mixin, base), {})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"policy": "MultiInputPolicy"}, "^`policy` 'MultiInputPolicy' is for Dict observations"),
        ({"policy": "CnnPolicy"}, "^`policy` 'CnnPolicy' is for images"),
        ({"n_steps": 0}, "^`n_steps` must be a whole number of at least 1"),
        ({"batch_size": 0}, "^`batch_size` must be a whole number of at least 1"),
        ({"buffer_size": 0}, "^`buffer_size` must be a whole number of at least 1"),
        (
            {"action_noise": {"type": "normal", "sigma": -0.1}},
            "^`action_noise`: 'sigma' must be a number of at least 0",
        ),
        ({"action_noise": {"type": "normal", "sigma": "big"}}, "^`action_noise`: 'sigma' must be a number"),
        ({"replay_buffer_class": HerReplayBuffer}, "needs Dict observations with .*achieved_goal, .* is missing"),
        (
            {"env": Line("dict"), "policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer},
            "achieved_goal, desired_goal, observation is missing in Dict",
        ),
    ],
)
def test_settings_of_sb3_that_cannot_work(settings, message):
    with pytest.raises(ValueError, match=f"(?s){message}"):
        build(SACAP, **settings)
