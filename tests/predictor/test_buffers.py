"""Replay buffers that feed K: which transitions and labels they store, and how they are loaded."""

import copy
import io
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecNormalize,
)
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from toy import Line, build, towards_centre

from sb3_sap import (
    DDPGAP,
    DQNAP,
    SACAP,
    KnowledgeBuffer,
    KnowledgeMixin,
    PermissibilityDictReplayBuffer,
    PermissibilityHerReplayBuffer,
    PermissibilityNStepReplayBuffer,
    PermissibilityReplayBuffer,
)
from sb3_sap.predictor.buffers import guided_buffer_class

VARIANTS = [
    pytest.param("array", {}, PermissibilityReplayBuffer, id="array"),
    pytest.param("array", {"n_steps": 3}, PermissibilityNStepReplayBuffer, id="n-step"),
    pytest.param("dict", {"policy": "MultiInputPolicy"}, PermissibilityDictReplayBuffer, id="dict"),
    pytest.param(
        "goal",
        {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer, "learning_starts": 30},
        PermissibilityHerReplayBuffer,
        id="her",
    ),
]


def k_rows(knowledge):
    """(observation, action, label) of everything in K as sorted tuples of numbers."""
    rows = []
    for part, slots in knowledge.parts.items():
        for label in (0, 1):
            for slot in knowledge._offset[part] + slots.slots(label):
                obs = [store[slot] for _, store in sorted(knowledge.observations.items())]
                rows.append((*np.concatenate([*obs, knowledge.actions[slot]]).round(5).tolist(), label))
    return sorted(rows)


def r_rows(buffer, n):
    """The first n transitions of R as :func:`k_rows` writes them, labelled by |x'| <= |x|."""
    keyed = buffer.observations if isinstance(buffer.observations, dict) else {"": buffer.observations}
    next_keyed = (
        buffer.next_observations if isinstance(buffer.next_observations, dict) else {"": buffer.next_observations}
    )
    where_x_is = "x" if "x" in keyed else "observation" if "observation" in keyed else ""
    rows = []
    for t in range(n):
        for i in range(buffer.n_envs):
            obs = [store[t, i] for _, store in sorted(keyed.items())]
            label = int(abs(next_keyed[where_x_is][t, i, 0]) <= abs(keyed[where_x_is][t, i, 0]))
            rows.append((*np.concatenate([*obs, buffer.actions[t, i]]).round(5).tolist(), label))
    return sorted(rows)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(("kind", "settings", "buffer_class"), VARIANTS)
def test_r_and_k_hold_the_same_transitions(kind, settings, buffer_class, n_envs):
    env = DummyVecEnv([lambda: Line(kind)] * n_envs)
    model = build(DDPGAP, env, **settings).learn(40 * n_envs)
    buffer = model.replay_buffer
    assert type(buffer) is buffer_class
    assert k_rows(buffer.knowledge) == r_rows(buffer, 40)
    assert buffer.knowledge.seen == list(np.bincount([row[-1] for row in k_rows(buffer.knowledge)], minlength=2))
    # The environments executed what was stored.
    for i, inner in enumerate(env.envs):
        np.testing.assert_allclose(np.array(inner.executed), buffer.actions[:40, i], atol=1e-6)


def test_labels_use_the_last_observation_of_an_episode_not_the_reset():
    seen = []

    def remember(obs, actions, next_obs):
        seen.append((obs[0, 1], next_obs[0, 1]))
        return towards_centre(obs, actions, next_obs)

    build(DDPGAP, Line(horizon=4, labels=False), ap_function=remember).learn(8)
    # Entry 1 is time: the step that ends an episode leads to 1, not to the 0 after the automatic reset.
    np.testing.assert_allclose(seen, [(0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1)] * 2)


@pytest.mark.parametrize("kind", ["array", "dict"])
def test_ap_function_gets_raw_observations_and_actions_in_env_units_under_vec_normalize(kind):
    calls = []

    def remember(obs, actions, next_obs):
        calls.append((obs, actions.copy(), next_obs))
        return towards_centre(obs, actions, next_obs)

    inner = DummyVecEnv([lambda: Line(kind, low=2.0, high=10.0, labels=False, horizon=4)] * 2)
    policy = "MlpPolicy" if kind == "array" else "MultiInputPolicy"
    model = build(DDPGAP, VecNormalize(inner), policy=policy, ap_function=remember).learn(60)
    times = [o[:, 1] if kind == "array" else o["time"][:, 0] for call in calls for o in (call[0], call[2])]
    xs = [o[:, 0] if kind == "array" else o["x"][:, 0] for call in calls for o in (call[0], call[2])]
    expected = [[t % 4 / 4 + step / 4] * 2 for t in range(30) for step in (0, 1)]
    np.testing.assert_allclose(times, expected, atol=1e-5)
    actions = np.array([call[1] for call in calls])  # (30, 2, 1)
    np.testing.assert_allclose(actions, np.swapaxes([env.executed for env in inner.envs], 0, 1), rtol=1e-5)
    assert actions.min() >= 2 - 1e-5
    assert actions.max() <= 10 + 1e-5
    # x' = x + 0.1 · (a - 6) / 4
    np.testing.assert_allclose(np.array(xs[1::2]) - xs[::2], 0.1 * (actions[:, :, 0] - 6) / 4, atol=1e-5)
    rows = k_rows(model.replay_buffer.knowledge)
    assert rows == r_rows(model.replay_buffer, 30)
    assert {row[1 if kind == "array" else 0] for row in rows} == {0, 0.25, 0.5, 0.75}  # K keeps raw times


def test_ap_function_takes_precedence_over_labels_in_info():
    model = build(DDPGAP, Line(), ap_function=lambda obs, actions, next_obs: np.ones(len(actions), bool)).learn(20)
    assert model.replay_buffer.knowledge.seen == [0, 20]


def test_failing_ap_function_leaves_both_buffers_unchanged():
    model = build(DDPGAP, Line(), ap_function=lambda obs, actions, next_obs: "no")
    with pytest.raises(TypeError, match="must return bool"):
        model.learn(5)
    assert len(model.replay_buffer.knowledge) == model.replay_buffer.pos == 0


@pytest.mark.filterwarnings("ignore:`ap_function` .* cannot be pickled")
@pytest.mark.parametrize(("kind", "settings", "buffer_class"), VARIANTS)
def test_pickled_buffer_omits_the_ap_function_and_keeps_k(kind, settings, buffer_class):
    class Unpicklable:
        def __call__(self, obs, actions, next_obs):
            return np.ones(len(actions), bool)

        def __reduce__(self):
            raise TypeError("not to be pickled")

    model = build(DDPGAP, Line(kind), ap_function=Unpicklable(), **settings).learn(25)
    restored = pickle.loads(pickle.dumps(model.replay_buffer))
    assert restored.ap_function is None
    assert model.replay_buffer.ap_function is model.ap_function
    assert k_rows(restored.knowledge) == k_rows(model.replay_buffer.knowledge)
    assert len(restored.knowledge) == 25


def test_loaded_replay_buffer_gets_the_ap_function_of_the_model():
    model = build(DDPGAP, Line(labels=False), ap_function=towards_centre).learn(10)
    file = io.BytesIO()
    model.save_replay_buffer(file)
    file.seek(0)
    model.load_replay_buffer(file)
    assert model.replay_buffer.ap_function is towards_centre
    model.learn(10)
    assert len(model.replay_buffer.knowledge) == 20


def test_loading_a_plain_replay_buffer_is_refused_and_changes_nothing():
    model = build(DDPGAP)
    own = model.replay_buffer
    file = io.BytesIO(pickle.dumps(ReplayBuffer(10, model.observation_space, model.action_space)))
    with pytest.raises(TypeError, match="plain ReplayBuffer without a knowledge buffer: load one saved by DDPGAP"):
        model.load_replay_buffer(file)
    assert model.replay_buffer is own


def test_buffer_requires_a_knowledge_buffer():
    with pytest.raises(TypeError, match="PermissibilityReplayBuffer needs `knowledge=KnowledgeBuffer"):
        PermissibilityReplayBuffer(10, spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (1,)))


BOX, DICT = spaces.Box(-1, 1, (2,)), spaces.Dict({"x": spaces.Box(-1, 1, (2,))})


class Mine(KnowledgeMixin, ReplayBuffer):
    pass


@pytest.mark.parametrize(
    ("requested", "space", "n_steps", "expected"),
    [
        (None, BOX, 1, PermissibilityReplayBuffer),
        (None, BOX, 3, PermissibilityNStepReplayBuffer),
        (None, DICT, 1, PermissibilityDictReplayBuffer),
        (ReplayBuffer, BOX, 1, PermissibilityReplayBuffer),
        (NStepReplayBuffer, BOX, 3, PermissibilityNStepReplayBuffer),
        (NStepReplayBuffer, BOX, 1, PermissibilityNStepReplayBuffer),
        (PermissibilityReplayBuffer, BOX, 3, PermissibilityNStepReplayBuffer),
        (PermissibilityNStepReplayBuffer, BOX, 1, PermissibilityNStepReplayBuffer),
        (DictReplayBuffer, DICT, 1, PermissibilityDictReplayBuffer),
        (HerReplayBuffer, DICT, 1, PermissibilityHerReplayBuffer),
        (PermissibilityHerReplayBuffer, DICT, 1, PermissibilityHerReplayBuffer),
        (Mine, BOX, 1, Mine),
    ],
)
def test_requested_buffer_class_maps_to_its_permissibility_variant(requested, space, n_steps, expected):
    assert guided_buffer_class(requested, space, n_steps) is expected


@pytest.mark.parametrize("requested", [RolloutBuffer, type("Foreign", (ReplayBuffer,), {})])
def test_buffer_class_that_does_not_feed_k_is_refused(requested):
    name = requested.__name__
    with pytest.raises(
        ValueError, match=rf"`replay_buffer_class` = {name} does not feed.*class Mine\(KnowledgeMixin, {name}"
    ):
        guided_buffer_class(requested, BOX, 1)


@pytest.mark.parametrize(
    ("requested", "space", "name"),
    [(None, DICT, "DictReplayBuffer"), (HerReplayBuffer, DICT, "HerReplayBuffer"), (ReplayBuffer, BOX, "ReplayBuffer")],
)
def test_n_steps_cannot_be_combined_with_one_step_buffers(requested, space, name):
    with pytest.raises(ValueError, match=rf"`n_steps` = 3 cannot be combined with {name}"):
        guided_buffer_class(requested, space, 3)


def test_n_step_buffer_gets_n_steps_and_gamma_of_the_model():
    buffer = build(DDPGAP, n_steps=3, gamma=0.8).replay_buffer
    assert (buffer.n_steps, buffer.gamma) == (3, 0.8)


def test_custom_buffer_class_gets_a_knowledge_buffer():
    model = build(DDPGAP, replay_buffer_class=Mine).learn(15)
    assert type(model.replay_buffer) is Mine
    assert isinstance(model.replay_buffer.knowledge, KnowledgeBuffer)
    assert len(model.replay_buffer.knowledge) == 15


@pytest.mark.parametrize("algorithm", [SACAP, DQNAP])
def test_functions_that_modify_their_arguments_change_neither_buffers_nor_actions(algorithm):
    def label(obs, actions, next_obs):
        good = towards_centre(obs, actions, next_obs)
        for array in (obs, actions, next_obs):
            array *= 0
        return good

    def allow(obs, actions):
        good = np.ones(len(actions), bool)
        obs *= 0
        actions *= 0
        return good

    env = Line(n_actions=3 if algorithm is DQNAP else None)
    settings = {"learning_starts": 1000}
    model = build(algorithm, env, ap_function=label, permissible_actions=allow, **settings).learn(40)
    plain = build(algorithm, Line(n_actions=3 if algorithm is DQNAP else None), **settings).learn(40)
    assert k_rows(model.replay_buffer.knowledge) == k_rows(plain.replay_buffer.knowledge)
    np.testing.assert_array_equal(model.replay_buffer.actions, plain.replay_buffer.actions)


def test_copied_model_keeps_its_ap_function():
    model = build(DDPGAP, Line(labels=False), ap_function=towards_centre).learn(20)
    copied = copy.deepcopy(model).learn(20)
    assert len(copied.replay_buffer.knowledge) == 40


@pytest.mark.parametrize(
    ("saved", "own", "message"),
    [
        ({"n_steps": 3}, {}, "with n_steps = 3, but this model's has None"),
        ({}, {"n_steps": 3}, "with n_steps = None, but this model's has 3"),
        ({"n_steps": 3}, {"n_steps": 3, "gamma": 0.5}, "with gamma = 0.99, but this model's has 0.5"),
    ],
)
def test_loading_a_buffer_with_other_n_step_returns_is_refused(saved, own, message):
    file = io.BytesIO()
    build(DDPGAP, **saved).learn(20).save_replay_buffer(file)
    file.seek(0)
    with pytest.raises(ValueError, match=f"^The file holds a replay buffer {message}"):
        build(DDPGAP, **own).load_replay_buffer(file)


def test_loading_a_buffer_without_hindsight_is_refused():
    goal = {"env": Line("goal"), "policy": "MultiInputPolicy", "learning_starts": 30}
    file = io.BytesIO()
    build(DDPGAP, **goal).learn(20).save_replay_buffer(file)
    file.seek(0)
    with pytest.raises(ValueError, match=r"^The file holds a PermissibilityDictReplayBuffer, but .* uses a Perm"):
        build(DDPGAP, **goal, replay_buffer_class=HerReplayBuffer).load_replay_buffer(file)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: DummyVecEnv([Line] * 2), "replay buffer of 2 environments, but this model has 1"),
        (lambda: Line(high=3.0), r"whose action_space is Box\(-1.0, 3.0"),
        (lambda: gym.wrappers.FlattenObservation(Line("dict", n_actions=None)), None),
    ],
)
def test_loading_a_buffer_of_another_environment_is_refused(other, message):
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
