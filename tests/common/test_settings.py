"""Invalid settings are refused in the constructor, in one sentence that names the setting and what was expected."""

import pytest
import sb3_contrib
import stable_baselines3
from stable_baselines3 import HerReplayBuffer
from toy import CONSTRAINED, GUIDED, Line, build

from sb3_sap import DDPGAP, SACAP, ActionPermissibilityMixin, ConstrainedExplorationMixin


@pytest.mark.parametrize("name", ["no_module.f", "toy.missing", "missing", 3])
def test_ap_function_that_cannot_be_imported_is_refused_in_the_constructor(name):
    with pytest.raises((TypeError, ValueError), match=r"^`ap_function`"):
        build(DDPGAP, ap_function=name)


@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_constraint_that_cannot_be_imported_is_refused_in_the_constructor(algorithm):
    with pytest.raises(ValueError, match=r"^`constraint`: 'toy\.missing' cannot be imported"):
        build(algorithm, constraint="toy.missing")


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
def test_invalid_settings_are_refused_in_the_constructor(algorithm, settings, message):
    with pytest.raises(ValueError, match=message):
        build(algorithm, **settings)


def test_unknown_predictor_kwargs_are_refused():
    with pytest.raises(TypeError, match=r"^`predictor_kwargs` holds 'layers', but .* takes net_arch, activation_fn"):
        build(DDPGAP, predictor_kwargs={"layers": [64]})


def test_smallest_valid_settings_train():
    build(
        DDPGAP, alpha=0, alpha_low=1, t_k=0, n_candidates=1, min_per_class=1, dataset_size=2, validation_size=2
    ).learn(60)
    build(DDPGAP, knowledge_buffer_size=100, min_per_class=45)
    build(DDPGAP, knowledge_buffer_size=16, min_per_class=7).learn(60)


@pytest.mark.parametrize("algorithm", [algorithm for algorithm in GUIDED if not algorithm.explores_without_noise])
def test_t_k_beyond_the_warm_up_without_noise_warns(algorithm):
    with pytest.warns(
        UserWarning, match="^`t_k` = 11 is beyond `learning_starts` = 10, but there is no `action_noise`"
    ):
        build(algorithm, t_k=11)


def test_guidance_end_before_the_first_guided_step_warns():
    with pytest.warns(UserWarning, match="^`guidance_end` = 10 leaves no step to guidance, which begins after 10"):
        build(DDPGAP, guidance_end=10)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "settings", [{"guidance_end": 11}, {"t_k": 10}, {"t_k": 11, "action_noise": {"type": "normal", "sigma": 0.1}}]
)
def test_settings_under_which_the_policy_explores_do_not_warn(settings):
    build(DDPGAP, **settings)
    build(SACAP, t_k=11)


def test_unknown_constructor_arguments_are_refused():
    with pytest.raises(TypeError, match="alhpa"):
        build(DDPGAP, alhpa=0.5)


@pytest.mark.parametrize("base", [stable_baselines3.PPO, stable_baselines3.A2C, sb3_contrib.TRPO])
@pytest.mark.parametrize("mixin", [ActionPermissibilityMixin, ConstrainedExplorationMixin])
def test_mixin_before_an_on_policy_algorithm_is_refused(mixin, base):
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
def test_invalid_settings_of_sb3_are_refused(settings, message):
    with pytest.raises(ValueError, match=f"(?s){message}"):
        build(SACAP, **settings)
