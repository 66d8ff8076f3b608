"""Plots, checked by the numbers in them."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import Line, build

from sb3_sap import DDPGAP, DQNAP
from sb3_sap.evaluation.predictor_plots import permissible_probability
from sb3_sap.plots import plot_permissibility, return_curves, save

LINEAR = {"net_arch": []}  # the predictor is one linear layer


def linear_model(weights, algorithm=DDPGAP, env=None, **kwargs):
    """A model whose predictor is the sigmoid of a weighted sum of (observation, action)."""
    model = build(algorithm, env, predictor_kwargs=LINEAR, **kwargs)
    with th.no_grad():
        model.predictor.head[0].weight.copy_(th.tensor([weights]))
        model.predictor.head[0].bias.zero_()
    model.predictor.n_updates += 1
    return model


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x)))


def mesh(figure):
    """(actions, values) of the picture, as drawn, and the actor's line."""
    axis = figure.axes[0]
    image = np.asarray(axis.collections[0].get_array())
    return image, axis.lines[0].get_xdata(), axis.lines[0].get_ydata()


def test_permissible_probability_is_given_for_every_state_and_action():
    model = linear_model([2.0, 0.0, 3.0], env=Line(low=-20.0, high=60.0))
    obs = np.array([[0.5, 0.0], [-1.0, 0.3]], dtype=np.float32)
    actions = np.array([[-20.0], [20.0], [60.0]])  # scaled: -1, 0, 1
    expected = sigmoid([[-2, 1, 4], [-5, -2, 1]])
    assert permissible_probability(model, obs, actions) == pytest.approx(expected, abs=1e-6)
    per_state = np.stack([actions, actions[::-1]])
    expected[1] = expected[1, ::-1]
    assert permissible_probability(model, obs, per_state) == pytest.approx(expected, abs=1e-6)


def test_plot_shows_probabilities_over_a_variable_and_an_action(tmp_path):
    model = linear_model([2.0, 1.0, 3.0])
    figure = plot_permissibility(model, 0, obs=np.array([9.0, 0.5], np.float32), limits=(-2, 2), variable_name="x [m]")
    image, values, actor = mesh(figure)
    assert image[0, 0] == pytest.approx(sigmoid(2 * -2 + 1 * 0.5 + 3 * -1))  # lowest action, lowest x
    assert image[-1, 0] == pytest.approx(sigmoid(2 * -2 + 1 * 0.5 + 3 * 1))
    assert image[0, -1] == pytest.approx(sigmoid(2 * 2 + 1 * 0.5 + 3 * -1))
    assert (values[0], values[-1]) == (-2, 2)
    states = np.column_stack([values, np.full(len(values), 0.5)]).astype(np.float32)
    assert actor == pytest.approx(model.predict(states, deterministic=True)[0][:, 0])
    assert figure.axes[0].get_xlabel() == "x [m]"
    save(figure, tmp_path / "region.png")
    assert (tmp_path / "region.png").stat().st_size > 5_000


def test_other_action_dimensions_are_those_of_the_actor():
    model = linear_model([0.0, 0.0, 0.0, 3.0], env=Line(dim=2))
    image, values, _ = mesh(plot_permissibility(model, action=0, limits=(-1, 1), obs=np.zeros(2, np.float32)))
    states = np.column_stack([values, np.zeros(len(values))]).astype(np.float32)
    second = model.predict(states, deterministic=True)[0][:, 1]
    assert image == pytest.approx(np.tile(sigmoid(3 * second), (len(image), 1)), abs=1e-6)


def test_variable_of_a_dict_observation_is_given_by_its_key():
    model = linear_model([1.0, 2.0, 0.0], env=Line("dict"), policy="MultiInputPolicy")  # keys: time, x, action
    held = {"x": np.zeros(1, np.float32), "time": np.full(1, 3.0, np.float32)}
    figure = plot_permissibility(model, ("x", 0), obs=held, limits=(-1, 1))
    assert mesh(figure)[0][0, [0, -1]] == pytest.approx(sigmoid([3 - 2, 3 + 2]))
    assert figure.axes[0].get_xlabel() == "x[0]"


def test_axes_are_named_as_in_code():
    axis = plot_permissibility(linear_model([0.0] * 4, env=Line(dim=2)), 1, action=1).axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("observation[1]", "action[1]")
    axis = plot_permissibility(linear_model([0.0] * 3)).axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("observation[0]", "action")
    goal = linear_model([0.0] * 5, env=Line("goal"), policy="MultiInputPolicy")
    assert plot_permissibility(goal, ("observation", 1)).axes[0].get_xlabel() == "observation[1]"


def test_discrete_actions_have_one_row_each():
    model = linear_model([0.0, 0.0, 1.0, 2.0, 3.0], DQNAP)
    image, values, actor = mesh(plot_permissibility(model, limits=(-1, 1)))
    assert image[:, 0] == pytest.approx(sigmoid([1, 2, 3]))
    assert set(actor) <= {0, 1, 2}
    assert len(actor) == len(values)


def test_limits_come_from_k_without_advancing_its_generator():
    model = build(DDPGAP).learn(100)
    generator = model.replay_buffer.knowledge.rng.bit_generator.state
    _, values, _ = mesh(plot_permissibility(model, 1))
    assert -0.2 <= values[0] < values[-1] <= 1  # steps / horizon
    assert model.replay_buffer.knowledge.rng.bit_generator.state == generator


def test_loaded_model_is_plotted_without_k(tmp_path):
    model = build(DDPGAP).learn(100)
    model.save(tmp_path / "model")
    loaded = DDPGAP.load(tmp_path / "model")
    figure = plot_permissibility(loaded)
    _, values, _ = mesh(figure)
    seen = model.replay_buffer.knowledge.observations[""]
    assert (loaded.typical_observation == seen).all(axis=1).any()  # one that occurred, as before saving
    np.testing.assert_array_equal(loaded.typical_observation, model.replay_buffer.knowledge.typical_observation())
    assert figure.axes[0].get_title() == ""
    assert (values[0], values[-1]) == (-1, 1)


def test_axes_are_in_env_units_under_vec_normalize():
    env = VecNormalize(DummyVecEnv([Line]))
    env.obs_rms.mean, env.obs_rms.var = np.array([5.0, 0.0]), np.array([4.0, 1.0])
    model = linear_model([1.0, 0.0, 0.0], env=env)
    image, _, _ = mesh(plot_permissibility(model, limits=(3, 7), obs=np.zeros(2, np.float32)))
    assert image[0, [0, -1]] == pytest.approx(sigmoid([-1, 1]), abs=1e-3)


@pytest.mark.parametrize("arguments", [{"variable": 2}, {"variable": -1}, {"action": 1}])
def test_indices_that_do_not_exist_are_refused(arguments):
    with pytest.raises(ValueError, match="no such variable"):
        plot_permissibility(linear_model([0.0, 0.0, 0.0]), **arguments)


def test_plot_without_a_fitted_predictor_is_refused():
    with pytest.raises(ValueError, match="train it first"):
        plot_permissibility(build(DDPGAP))


def test_return_curves_show_each_run_and_the_mean(tmp_path):
    for name, returns in {"a": [1, 3], "b": [5, 7]}.items():
        rows = "".join(f"{r},10,{10 * i}\n" for i, r in enumerate(returns))
        (tmp_path / name).mkdir()
        (tmp_path / name / "monitor.csv").write_text('#{"t_start": 0, "env_id": "x"}\nr,l,t\n' + rows)
    (tmp_path / "c.monitor.csv").write_text((tmp_path / "a" / "monitor.csv").read_text())  # Monitor(env, "c")
    axis = return_curves({"both": [tmp_path / "a", tmp_path / "b"], "one": tmp_path / "c"}, window=1).axes[0]
    faint, _, mean, one = axis.lines
    assert faint.get_xydata().tolist() == [[10, 1], [20, 3]]
    assert mean.get_ydata()[[0, -1]].tolist() == [3, 5]
    assert one.get_ydata()[[0, -1]].tolist() == [1, 3]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["both", "one"]


def test_missing_monitor_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="as SB3's Monitor writes"):
        return_curves({"a": tmp_path / "nothing"})
