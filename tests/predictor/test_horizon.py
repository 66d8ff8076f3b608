"""Mistakes that show later: windows of observations, events, and what their labels change once they are known."""

import numpy as np
import pytest
from gymnasium import spaces
from scripted import FIRST, SECOND, THIRD, Scripted, envs, expected, labels_of, steps_of
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from states import assert_same_state
from toy import Line, build, towards_centre

from sb3_sap import DDPGAP, DQNAP, SACAP
from sb3_sap.predictor.pending import Pending


def untrained(algorithm, env, **settings):
    """A model that only acts at random."""
    return build(algorithm, env, **({"learning_starts": 10_000} | settings))


def fell(obs, actions, next_obs):
    """The cost of `FIRST` as a function: at the second step of each second episode."""
    assert obs.shape == next_obs.shape
    return (obs[:, 1] % 2 == 1) & (obs[:, 2] == 1)


class Windows:
    """An AP function that permits what is followed by an even last step, and keeps its windows."""

    def __init__(self):
        self.seen = {}

    def __call__(self, obs, actions, next_obs):
        for row, action, window in zip(obs, actions, next_obs, strict=True):
            assert -1 <= action[0] <= 1
            self.seen[tuple(map(int, row))] = window
        return next_obs[:, -1, 2] % 2 == 0


# ---------------------------------------------------------------- labels by hand


def test_termination_blames_the_last_actions_and_a_truncated_episode_leaves_its_end_open():
    model = untrained(DDPGAP, envs(), event="terminated", horizon=2).learn(7)
    assert labels_of(model) == {
        (0, 0, 0): True,  # steps 0 and 1 passed
        (0, 0, 1): False,
        (0, 0, 2): False,
        (0, 1, 0): True,
        (0, 1, 1): True,
        (0, 1, 2): True,  # its two steps passed, the last one included
    }


@pytest.mark.parametrize("event", ["cost", fell, "test_horizon.fell"])
def test_event_blames_the_actions_up_to_its_own(event):
    model = untrained(DDPGAP, envs(), event=event, horizon=2).learn(7)
    assert labels_of(model) == {
        (0, 0, 0): True,
        (0, 0, 1): True,
        (0, 0, 2): True,  # the episode terminated without an event
        (0, 1, 0): False,
        (0, 1, 1): False,
        (0, 1, 2): True,
    }


@pytest.mark.parametrize("event", ["terminated", "cost"])
@pytest.mark.parametrize("horizon", [1, 2, 3, 6, 20])
def test_labels_of_three_environments_are_those_of_the_definition(event, horizon):
    scripts = (FIRST, SECOND, THIRD)
    model = untrained(SACAP, envs(*scripts), event=event, horizon=horizon).learn(3 * 40)
    found = labels_of(model)
    assert found == expected(scripts, 40, horizon, event)
    assert set(found.values()) == ({False} if (event, horizon) == ("terminated", 20) else {False, True})
    assert sum(model.knowledge.seen) == len(found)


def test_window_holds_the_next_observations_and_repeats_the_last_one_of_an_episode():
    windows = Windows()
    model = untrained(DDPGAP, envs(), ap_function=windows, horizon=3).learn(9)
    steps = {place: window[:, 2].tolist() for place, window in windows.seen.items()}
    assert steps == {
        (0, 0, 0): [1, 2, 3],
        (0, 0, 1): [2, 3, 3],
        (0, 0, 2): [3, 3, 3],
        (0, 1, 0): [1, 2, 3],
        (0, 1, 1): [2, 3, 4],
        (0, 1, 2): [3, 4, 4],
        (0, 1, 3): [4, 4, 4],  # although the episode was truncated
    }
    assert all((window[:, :2] == place[:2]).all() for place, window in windows.seen.items())
    assert labels_of(model) == {place: window[-1] % 2 == 0 for place, window in steps.items()}
    assert len(model.replay_buffer.pending) == 2  # the two steps of the third episode


@pytest.mark.parametrize("normalised", [False, True])
def test_windows_of_several_environments_are_raw_and_true(normalised):
    windows, env = Windows(), envs(FIRST, SECOND, THIRD)
    model = untrained(DDPGAP, VecNormalize(env) if normalised else env, ap_function=windows, horizon=4).learn(60)
    assert len(windows.seen) > 40
    for (number, episode, time), window in windows.seen.items():
        script = (FIRST, SECOND, THIRD)[number]
        length = script[episode % len(script)][0]
        times = [min(time + i, length) for i in range(1, 5)]
        np.testing.assert_array_equal(window, [(number, episode, t) for t in times])
    assert labels_of(model).keys() == windows.seen.keys()


def test_windows_of_dict_observations_have_one_array_for_each_key():
    shapes = []

    def ap_function(obs, actions, next_obs):
        shapes.append((len(actions), next_obs["place"].shape, next_obs["again"].shape))
        np.testing.assert_array_equal(next_obs["again"], 2 * next_obs["place"])
        return next_obs["place"][:, -1, 2] % 2 == 0

    env = envs(FIRST, SECOND, keyed=True)
    model = untrained(DDPGAP, env, policy="MultiInputPolicy", ap_function=ap_function, horizon=2).learn(30)
    assert all(one == other == (n, 2, 3) for n, one, other in shapes)
    assert len(labels_of(model)) == sum(n for n, _, _ in shapes) > 20


def test_discrete_actions_are_labelled_late_as_they_are():
    seen = []

    def ap_function(obs, actions, next_obs):
        seen.extend(zip(obs[:, 2].astype(int), actions, strict=True))
        return actions == 1

    env = envs(FIRST, SECOND, action_space=spaces.Discrete(3))
    model = untrained(DQNAP, env, ap_function=ap_function, horizon=2).learn(20)
    kept = [float(row[0]) for row in model.knowledge.actions[model.knowledge._filled()]]
    assert sorted(kept) == sorted(float(action) for _, action in seen)
    assert model.knowledge.seen[1] == kept.count(1.0) > 0


def test_horizon_of_one_is_the_model_without_the_argument_to_the_bit():
    settings = {"ap_function": towards_centre, "penalty": "auto", "learning_starts": 10}
    plain, given = (build(SACAP, **settings, **extra).learn(60) for extra in ({}, {"horizon": 1}))
    assert_same_state(plain, given)
    np.testing.assert_array_equal(plain.replay_buffer.added, given.replay_buffer.added)
    assert given.replay_buffer.pending is None


def did_not_fall(obs, actions, next_obs):
    return ~fell(obs, actions, next_obs)


def test_event_of_one_step_equals_its_ap_function_to_the_bit():
    settings = {"penalty": 4.0, "learning_starts": 10}
    one = untrained(SACAP, envs(FIRST, SECOND), event=fell, **settings).learn(60)
    other = untrained(SACAP, envs(FIRST, SECOND), ap_function=did_not_fall, **settings).learn(60)
    assert_same_state(one, other)
    assert one.predictor.fitted


# ---------------------------------------------------------------- rewards


@pytest.mark.parametrize("scripts", [(FIRST,), (FIRST, SECOND, THIRD)])
@pytest.mark.parametrize("event", ["terminated", "cost"])
def test_penalty_reaches_the_stored_reward_when_the_label_is_known(scripts, event):
    model = untrained(DDPGAP, envs(*scripts), event=event, horizon=3, penalty=4.0).learn(len(scripts) * 30)
    buffer, labels = model.replay_buffer, expected(scripts, 30, 3, event)
    penalties = [[-4.0 * (labels.get(p) is False) for p in row] for row in steps_of(buffer.observations[:30])]
    np.testing.assert_array_equal(buffer.added[:30], penalties)
    np.testing.assert_array_equal(buffer.rewards[:30], 10 + np.array(penalties))
    assert np.min(penalties) == -4


def test_rows_that_were_overwritten_meanwhile_keep_their_reward():
    # Three environments have buffers of 4 rows, and an episode of 7 steps is judged at once, at its end.
    long = [(7, True, ())]
    model = untrained(DDPGAP, envs(long, long, long), event="terminated", horizon=7, penalty=4.0, buffer_size=12)
    model.learn(3 * 7)
    buffer = model.replay_buffer
    assert len(buffer.rewards) == 4
    np.testing.assert_array_equal(buffer.rewards, np.full((4, 3), 6.0))
    assert [row[0][2] for row in steps_of(buffer.observations)] == [4, 5, 6, 3]
    assert model.knowledge.seen == [21, 0]
    model.learn(3 * 3, reset_num_timesteps=False)
    np.testing.assert_array_equal(buffer.rewards, [[10.0] * 3, [10.0] * 3, [6.0] * 3, [10.0] * 3])


def test_potential_is_added_at_once_and_the_penalty_later():
    def potential(obs):
        return obs[:, 2].astype(float)

    settings = {"event": "terminated", "horizon": 2, "penalty": 4.0, "gamma": 0.5}
    model = untrained(DDPGAP, envs(), potential=potential, **settings).learn(2)
    np.testing.assert_allclose(model.replay_buffer.added[:3, 0], [0.5 - 0, 1.0 - 1, 0])
    model.learn(1, reset_num_timesteps=False)
    np.testing.assert_allclose(model.replay_buffer.added[:3, 0], [0.5 - 0, 1.0 - 1 - 4, 0.0 - 2 - 4])


def test_returns_of_several_steps_hold_the_late_penalty():
    model = untrained(DDPGAP, envs(), event="terminated", horizon=2, penalty=4.0, n_steps=3, gamma=0.5).learn(4)
    data = model.replay_buffer._get_samples(np.array([0]))
    assert float(data.rewards) == 10 + 0.5 * 6 + 0.25 * 6


def test_hindsight_buffer_fills_k_and_shapes_without_labels():
    her = {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer, "learning_starts": 30}
    seen = []

    def ap_function(obs, actions, next_obs):
        seen.append(next_obs["observation"].shape[1:])
        return np.ones(len(actions), bool)

    def potential(obs):
        return -np.abs(obs["achieved_goal"][:, 0]).astype(float)

    model = build(SACAP, Line(kind="goal"), **her, ap_function=ap_function, horizon=2, potential=potential).learn(50)
    assert set(seen) == {(2, 2)}
    assert sum(model.knowledge.seen) == 50


# ---------------------------------------------------------------- episodes that are left, files


def test_new_learn_drops_what_was_pending_and_going_on_keeps_it():
    long = [(7, True, (2,))]
    model = untrained(DDPGAP, envs(long), event="cost", horizon=5)
    model.learn(2)
    model.learn(1, reset_num_timesteps=False)  # the step with a cost
    assert labels_of(model) == {(0, 0, t): False for t in range(3)}
    model.learn(2)
    assert len(model.replay_buffer.pending) == 2
    model.set_env(envs(long))
    model.learn(3, reset_num_timesteps=False)
    assert model.knowledge.seen == [6, 0]


def test_episode_that_somebody_else_left_is_noticed():
    pending = Pending(3)
    first, second = np.array([[0.0], [5.0]]), np.array([[1.0], [6.0]])
    action, no = np.zeros((2, 1)), np.zeros(2, bool)
    pending.extend(first, action, second)
    pending.extend(np.array([[1.0], [7.0]]), action, np.array([[2.0], [8.0]]))
    assert [one.env for one in pending.take(np.ones(2, bool), no)] == [0, 0, 1]


def last_is_even(obs, actions, next_obs):
    return next_obs[:, -1, 2] % 2 == 0


@pytest.mark.parametrize("source", [{"event": "cost"}, {"ap_function": last_is_even}])
def test_loaded_model_goes_on_as_if_it_had_not_been_saved(tmp_path, source):
    settings = {**source, "horizon": 3, "penalty": 2.0}
    whole, parted = (untrained(DDPGAP, envs(FIRST, SECOND), **settings).learn(24) for _ in range(2))
    parted.save(tmp_path / "model")
    parted.save_replay_buffer(tmp_path / "buffer")
    loaded = DDPGAP.load(tmp_path / "model", env=parted.env, force_reset=False)
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert len(loaded.replay_buffer.pending) == (2 if "event" in source else 4)
    for model in (whole, loaded):
        model.action_space.seed(3)
        model.learn(20, reset_num_timesteps=False)
    assert_same_state(whole, loaded)
    np.testing.assert_array_equal(whole.replay_buffer.added, loaded.replay_buffer.added)
    assert len(labels_of(whole)) > 25


def test_loaded_model_in_a_new_episode_drops_what_was_pending(tmp_path):
    parted = untrained(DDPGAP, envs(THIRD), event="cost", horizon=5).learn(2)
    parted.save(tmp_path / "model")
    parted.save_replay_buffer(tmp_path / "buffer")
    loaded = DDPGAP.load(tmp_path / "model", env=envs(THIRD))
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(3, reset_num_timesteps=False)
    assert loaded.knowledge.seen == [3, 0]


# ---------------------------------------------------------------- metric and errors


def test_rate_counts_labels_as_they_become_known():
    rates = []

    class Recorder(Logger):
        def record_mean(self, name, value, *args):
            if name == "sap/permissible_rate":
                rates.append(float(value))

    model = untrained(DDPGAP, envs(), event="terminated", horizon=2)
    model.set_logger(Recorder(None, []))
    model.learn(3)
    assert rates == [1.0, 0.0]  # at the second step one label, at the third two


def takes_arrays(obs, actions, next_obs):
    return np.zeros((len(actions), 2), bool)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": 0}, "^`horizon` must be a whole number of at least 1, but is 0"),
        ({"horizon": 1.5}, "^`horizon` must be a whole number of at least 1, but is 1.5"),
        ({"ap_function": towards_centre, "event": "cost"}, "^`ap_function` and `event` were both given"),
        ({"horizon": 3}, "^`horizon` = 3 needs an `ap_function` or an `event`"),
        (
            {"ap_function": lambda obs, actions, next_obs: next_obs[:, 0] > obs[:, 0], "horizon": 3},
            r"^`ap_function, horizon=3` <lambda> returned an array of shape \(3, 3\) for 3 actions",
        ),
        ({"event": "pain"}, "^`event` = 'pain' is not in the environment's `info`, .* has 'cost'"),
        ({"event": "toy.missing"}, "^`event`: 'toy.missing' cannot be imported"),
        ({"event": takes_arrays}, r"^`event` takes_arrays returned an array of shape \(1, 2\) for 1 actions"),
    ],
)
def test_wrong_setting_gets_one_sentence(settings, message):
    with pytest.raises(ValueError, match=message):
        untrained(DDPGAP, envs(), **settings).learn(5)


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (3, '^`event` must be "terminated", a key of `info` .* but is 3'),
        (lambda obs, actions, next_obs: obs[:, 0], "must return bool: True where it happened"),
    ],
)
def test_wrong_type_of_event_gets_one_sentence(event, message):
    with pytest.raises(TypeError, match=message):
        untrained(DDPGAP, envs(), event=event).learn(5)


def test_cost_that_is_no_number_gets_one_sentence():
    class Worded(Scripted):
        def step(self, action):
            return (*super().step(action)[:4], {"cost": "much"})

    with pytest.raises(TypeError, match=r"^`info\['cost'\]` must be a number, .* but is 'much'"):
        untrained(DDPGAP, Worded(), event="cost").learn(5)


def test_penalty_and_hindsight_goals_are_refused():
    her = {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer, "penalty": 1.0}
    for source in ({"event": "terminated"}, {"ap_function": towards_centre, "horizon": 2}):
        with pytest.raises(
            ValueError, match=r"^`penalty` = 1.0 with `horizon` above 1 or an `event` cannot be combined"
        ):
            build(SACAP, Line(kind="goal"), **her, **source)


@pytest.mark.parametrize("source", [{"event": "cost"}, {"ap_function": towards_centre, "horizon": 2}])
def test_logs_need_labels_of_their_own(source):
    log = {"obs": np.zeros((9, 3), np.float32), "actions": np.zeros((9, 1), np.float32)}
    log["next_obs"] = log["obs"]
    model = untrained(DDPGAP, envs(), **source)
    with pytest.raises(ValueError, match=r"^The transitions have no labels, and this model's `horizon` or `event`"):
        model.add_knowledge(log)
    labels = np.arange(9) % 2 == 0
    report = model.add_knowledge({**log, "labels": labels})
    assert (report.permissible, report.non_permissible) == (5, 4)
