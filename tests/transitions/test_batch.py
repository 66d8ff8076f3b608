"""Transitions of elsewhere are checked against the spaces, row by row."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_sap.transitions.batch import fitting, transitions_of

SPACE = spaces.Box(-np.inf, np.inf, (2,), np.float32)
ACTIONS = spaces.Box(np.array([0.0], np.float32), np.array([10.0], np.float32))


def arrays(n=4, **changes):
    obs = np.arange(2 * n, dtype=np.float64).reshape(n, 2)
    return {"obs": obs, "actions": np.full((n, 1), 5.0), "next_obs": obs + 1} | changes


def test_float64_becomes_the_dtype_of_the_space():
    batch, sound, refused = fitting(transitions_of(arrays()), SPACE, ACTIONS)
    assert (batch.obs.dtype, batch.actions.dtype) == (np.float32, np.float32)
    assert sound.all()
    assert not any(refused.values())


@pytest.mark.parametrize("name", ["obs", "actions", "next_obs", "rewards"])
def test_row_that_is_not_finite_is_refused_alone(name):
    broken = arrays(rewards=np.zeros(4))
    broken[name] = broken[name].copy()
    broken[name].reshape(4, -1)[2] = np.nan
    _, sound, refused = fitting(transitions_of(broken), SPACE, ACTIONS)
    assert sound.tolist() == [True, True, False, True]
    assert refused["not finite"] == 1


def test_action_out_of_bounds_is_refused_and_one_that_was_rounded_is_put_on_the_bound():
    given = arrays(actions=np.array([[0.0], [10.005], [10.1], [-3.0]]))
    batch, sound, refused = fitting(transitions_of(given), SPACE, ACTIONS)
    assert sound.tolist() == [True, True, False, False]
    assert batch.actions[1, 0] == 10
    assert refused["action out of bounds"] == 2


@pytest.mark.parametrize(
    ("space", "actions", "sound"),
    [
        (spaces.Discrete(3), [0, 2, 3, -1], [True, True, False, False]),
        (spaces.Discrete(3, start=1), [0, 1, 3, 4], [False, True, True, False]),
        (spaces.MultiDiscrete([2, 3]), [[1, 2], [2, 0], [0, 0], [0, 3]], [True, False, True, False]),
        (spaces.MultiBinary(2), [[1, 1], [0, 2], [0, 0], [1, 0]], [True, False, True, True]),
    ],
)
def test_discrete_actions_outside_of_the_space_are_refused(space, actions, sound):
    _, found, _ = fitting(transitions_of(arrays(actions=np.array(actions))), SPACE, space)
    assert found.tolist() == sound


def test_discrete_actions_logged_as_floats_are_whole_numbers():
    batch, sound, _ = fitting(transitions_of(arrays(actions=np.array([0.0, 1.0, 2.0, 1.0]))), SPACE, spaces.Discrete(3))
    assert batch.actions.dtype == np.int64
    assert sound.all()
    with pytest.raises(ValueError, match="no whole numbers"):
        fitting(transitions_of(arrays(actions=np.array([0.5, 1, 2, 1]))), SPACE, spaces.Discrete(3))


def test_single_number_may_be_a_column_or_not():
    for actions in (np.full(4, 5.0), np.full((4, 1), 5.0)):
        batch, _, _ = fitting(transitions_of(arrays(actions=actions)), SPACE, ACTIONS)
        assert batch.actions.shape == (4, 1)


def test_images_may_be_scaled_to_one_by_mistake():
    images = spaces.Box(0, 255, (3, 8, 8), np.uint8)
    scaled = np.random.default_rng(0).random((4, 3, 8, 8))
    with pytest.raises(ValueError, match="neither normalised nor scaled"):
        fitting(transitions_of(arrays(obs=scaled, next_obs=scaled)), images, ACTIONS)


def test_images_in_the_environments_layout_are_transposed():
    images = spaces.Box(0, 255, (3, 8, 8), np.uint8)
    pictures = np.random.default_rng(0).integers(0, 256, (4, 8, 8, 3))
    batch, _, _ = fitting(transitions_of(arrays(obs=pictures, next_obs=pictures)), images, ACTIONS)
    np.testing.assert_array_equal(batch.obs, pictures.transpose(0, 3, 1, 2))


def test_dict_observations_need_their_keys():
    space = spaces.Dict({"x": spaces.Box(-1, 1, (1,)), "time": spaces.Box(0, 1, (1,))})
    one = {"x": np.zeros(4), "time": np.zeros((4, 1))}
    batch, _, _ = fitting(transitions_of(arrays(obs=one, next_obs=one)), space, ACTIONS)
    assert batch.obs["x"].shape == (4, 1)
    with pytest.raises(ValueError, match="each of time, x"):
        fitting(transitions_of(arrays(obs={"x": np.zeros(4)}, next_obs=one)), space, ACTIONS)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"obs": None}, "need an array 'obs'"),
        ({"action": np.zeros(4)}, "did you mean 'actions'"),
        ({"rewards": np.zeros(3)}, "there are 4 actions"),
        ({"labels": np.array([0.1, 1, 0, 1])}, "`labels` must be True or False"),
        ({"labels": np.array([np.nan, 1, 0, 1])}, "`labels` must be True or False"),
    ],
)
def test_what_is_wrong_with_arrays_is_said(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        transitions_of(arrays(**change))


def test_wrong_number_of_values_is_said():
    with pytest.raises(ValueError, match=r"`obs` has the shape \(4, 3\)"):
        fitting(transitions_of(arrays(obs=np.zeros((4, 3)))), SPACE, ACTIONS)


def test_nan_where_whole_numbers_belong_is_refused_row_by_row():
    actions = np.array([0.0, np.nan, 2.0, 1.0])
    batch, sound, _ = fitting(transitions_of(arrays(actions=actions)), SPACE, spaces.Discrete(3))
    assert sound.tolist() == [True, False, True, True]
    assert batch.actions.tolist() == [0, 0, 2, 1]


def test_observation_that_a_finite_space_does_not_have_is_refused():
    given = arrays(obs=np.array([0, 1, 5, 2]), next_obs=np.array([0, 1, 2, 3]))
    _, sound, refused = fitting(transitions_of(given), spaces.Discrete(3), ACTIONS)
    assert sound.tolist() == [True, True, False, False]
    assert refused["observation that the space does not have"] == 2


@pytest.mark.parametrize("name", ["rewards", "dones"])
def test_one_value_for_each_row(name):
    with pytest.raises(ValueError, match="one value for each of 4 rows"):
        transitions_of(arrays(**{name: np.zeros((4, 2))}))
