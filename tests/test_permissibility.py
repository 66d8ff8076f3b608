"""Labels: from the wrapper, from an AP function, and from info; functions that do not label are refused."""

import re

import numpy as np
import pytest
from toy import GUIDED, Line, build, towards_centre

from sb3_sap import DDPGAP, ActionPermissibility
from sb3_sap.permissibility import labels_from_infos, query_labels


def closer(obs, action, next_obs):
    return bool(abs(next_obs[0]) <= abs(obs[0]))


@pytest.mark.parametrize("reuse", [False, True], ids=["fresh arrays", "one array overwritten"])
def test_wrapper_labels_with_the_observation_before_the_step(reuse):
    env = ActionPermissibility(Line(labels=False, reuse=reuse), closer)
    env.reset(options={"x": 0.5})
    labels = [env.step(np.array([action]))[4]["permissible"] for action in (-1.0, 1.0, 1.0, -1.0)]
    assert labels == [True, False, False, True]  # x: 0.5 -> 0.4 -> 0.5 -> 0.6 -> 0.5


def test_wrapper_takes_the_observation_of_a_reset():
    env = ActionPermissibility(Line(labels=False, reuse=True), lambda obs, action, next_obs: float(obs[1]) == 0.0)
    env.reset(seed=0)
    assert env.step(np.array([0.0]))[4]["permissible"]  # time 0 at the reset
    assert not env.step(np.array([0.0]))[4]["permissible"]
    env.reset()
    assert env.step(np.array([0.0]))[4]["permissible"]


def test_wrapper_passes_the_action_and_both_dict_observations():
    seen = []

    def permissible(obs, action, next_obs):
        seen.append((obs["time"].item(), action.item(), next_obs["time"].item()))
        return True

    env = ActionPermissibility(Line("dict", labels=False), permissible)
    env.reset(seed=0)
    info = env.step(np.array([0.25]))[4]
    assert info == {"permissible": True}
    assert seen == [(0.0, 0.25, pytest.approx(0.1))]


def test_wrapper_requires_a_function():
    with pytest.raises(TypeError, match=r"`permissible` must be a function \(obs, action, next_obs\) -> bool.*is True"):
        ActionPermissibility(Line(), True)


OBS = np.array([[1.0, 0.0], [1.0, 0.0]])
NEXT = np.array([[0.9, 0.0], [1.1, 0.0]])
ACTIONS = np.array([[-1.0], [1.0]])


def test_function_labels_are_returned_row_by_row():
    np.testing.assert_array_equal(query_labels(towards_centre, "ap_function", OBS, ACTIONS, NEXT), [True, False])


def raises(obs, actions, next_obs):
    raise IndexError("no such column")


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (
            raises,
            RuntimeError,
            "`ap_function` raises raised IndexError: no such column. It is called with batches (obs, actions, "
            "next_obs) of n = 2 rows; here the actions have shape (2, 1).",
        ),
        (lambda o, a, n: np.array([1, 0]), TypeError, "returned values of type int64, but must return bool"),
        (lambda o, a, n: np.array([1.0, 0.0]), TypeError, "returned values of type float64, but must return bool"),
        (lambda o, a, n: np.array([np.nan, 1.0]), TypeError, "returned NaN, but must return bool"),
        (lambda o, a, n: True, ValueError, "returned an array of shape () for 2 actions, but must return shape (2,)"),
        (
            lambda o, a, n: a > 0,
            ValueError,
            "returned an array of shape (2, 1) for 2 actions, but must return shape (2,)",
        ),
        (lambda o, a, n: np.array([True]), ValueError, "returned an array of shape (1,) for 2 actions"),
    ],
)
def test_invalid_return_values_are_refused(function, error, message):
    with pytest.raises(error, match=re.escape(message)):
        query_labels(function, "ap_function", OBS, ACTIONS, NEXT)


def test_info_labels_are_collected_in_the_order_of_the_environments():
    labels = labels_from_infos([{"permissible": True}, {"permissible": np.False_}])
    np.testing.assert_array_equal(labels, [True, False])
    assert labels.dtype == bool


def test_missing_label_in_info_is_refused_with_both_alternatives():
    with pytest.raises(ValueError, match=r"There is no AP function.*`ap_function=`.*ActionPermissibility"):
        labels_from_infos([{"permissible": True}, {}])


@pytest.mark.parametrize("label", [1, float("nan"), None, np.array([True])])
def test_info_label_must_be_bool(label):
    with pytest.raises(TypeError, match=r'`info\["permissible"\]` must be a bool, but is'):
        labels_from_infos([{"permissible": label}])


@pytest.mark.parametrize("algorithm", GUIDED)
def test_missing_ap_function_is_refused_at_the_first_step(algorithm):
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
def test_invalid_ap_function_is_refused_at_the_first_step(algorithm, ap_function, error, message):
    model = build(algorithm, ap_function=ap_function)
    with pytest.raises(error, match=message):
        model.learn(100)
    assert model.num_timesteps == 1


def test_wrapper_that_labels_with_numbers_is_refused():
    with pytest.raises(TypeError, match=r'^`info\["permissible"\]` must be a bool, but is 1\.$'):
        build(DDPGAP, ActionPermissibility(Line(), lambda obs, action, next_obs: 1)).learn(100)
