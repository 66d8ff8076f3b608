"""The extractor that rescales observations, and extractors that are given by name."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_sap import DDPGAP, GoalGapExtractor, RescaleExtractor
from sb3_sap.tasks import mountain_car_continuous

CAR = "MountainCarContinuous-v0"
NAMED = {"net_arch": [4], "features_extractor_class": "sb3_sap.RescaleExtractor"}


def test_rescale_extractor_scales_bounded_entries_and_leaves_unbounded_ones():
    huge = np.finfo(np.float32).max
    low, high = [-1.2, -0.07, -np.inf, 0, -huge, 3], [0.6, 0.07, np.inf, np.inf, huge, 3]
    extractor = RescaleExtractor(spaces.Box(np.float32(low), np.float32(high), dtype=np.float32))
    assert extractor.features_dim == 6
    seen = extractor(th.tensor([[0.6, -0.07, 9.0, 8.0, -7.0, 3.0], [-0.3, 0.035, 0.0, 0.0, 0.0, 3.0]]))
    np.testing.assert_allclose(seen, [[1, -1, 9, 8, -7, 3], [0, 0.5, 0, 0, 0, 3]], atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_bounds_beyond_single_precision_count_as_unbounded():
    extractor = RescaleExtractor(spaces.Box(-1e300, 1e300, (1,), np.float64))
    np.testing.assert_array_equal(extractor(th.tensor([[5.0]])), [[5.0]])


def test_rescale_extractor_flattens_observations():
    extractor = RescaleExtractor(spaces.Box(-2, 2, (2, 2), np.float32))
    np.testing.assert_allclose(extractor(th.tensor([[[2.0, 1.0], [0.0, -2.0]]])), [[1, 0.5, 0, -1]])


def test_extractor_given_by_name_is_used_by_policy_and_predictor_and_kept_in_the_file(tmp_path):
    env = gym.make(CAR)
    model = DDPGAP("MlpPolicy", env, ap_function=mountain_car_continuous, policy_kwargs=NAMED, seed=0)
    for network in (model.actor, model.critic, model.predictor):
        assert type(network.features_extractor) is RescaleExtractor
    assert NAMED["features_extractor_class"] == "sb3_sap.RescaleExtractor"  # the caller's dictionary is not modified
    model.save(tmp_path / "model")
    loaded = DDPGAP.load(tmp_path / "model", env)
    obs = env.observation_space.sample()
    np.testing.assert_array_equal(model.predict(obs)[0], loaded.predict(obs)[0])
    assert type(loaded.actor.features_extractor) is RescaleExtractor


def test_predictor_can_have_another_extractor():
    plain = {"features_extractor_class": "stable_baselines3.common.torch_layers.FlattenExtractor"}
    env = gym.make(CAR)
    model = DDPGAP(
        "MlpPolicy", env, ap_function=mountain_car_continuous, policy_kwargs=NAMED, predictor_kwargs=plain, seed=0
    )
    assert type(model.predictor.features_extractor) is FlattenExtractor
    assert type(model.actor.features_extractor) is RescaleExtractor


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.Dict({"x": spaces.Box(-1, 1)}), spaces.Box(0, 255, (36, 36, 3), np.uint8)]
)
def test_rescale_extractor_refuses_other_observation_spaces(space):
    with pytest.raises(ValueError, match=r"^RescaleExtractor is for arrays of numbers, but .*leave `features_extr"):
        RescaleExtractor(space)


def test_extractor_that_cannot_be_imported_is_refused():
    wrong = {"features_extractor_class": "sb3_sap.RescaleExtractr"}
    with pytest.raises(ValueError, match=r"^`features_extractor_class`: 'sb3_sap\.RescaleExtractr' cannot be imported"):
        DDPGAP("MlpPolicy", gym.make(CAR), ap_function=mountain_car_continuous, policy_kwargs=wrong)


def goal_space():
    box = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    return spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})


def test_goal_is_read_as_the_gap_in_units():
    extractor = GoalGapExtractor(goal_space(), unit=0.5, entries=[2])
    rows = {
        "achieved_goal": [[1.0, 2.0, 3.0]],
        "desired_goal": [[1.5, 2.0, 2.5]],
        "observation": [[7.0, 8.0, 9.0]],
    }
    assert extractor({key: th.tensor(value) for key, value in rows.items()}).tolist() == [[1, 0, -1, 18]]
    assert GoalGapExtractor(goal_space()).features_dim == 3


@pytest.mark.parametrize(
    ("space", "arguments", "sentence"),
    [
        (spaces.Box(-1, 1, (2,)), {}, "^GoalGapExtractor needs a Dict observation with observation, achieved_goal"),
        (goal_space(), {"unit": 0}, "^`unit` of GoalGapExtractor must be a number above 0, but is 0"),
    ],
)
def test_wrong_arguments_of_the_gap_get_one_sentence(space, arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        GoalGapExtractor(space, **arguments)
