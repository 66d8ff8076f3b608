"""Each kind of source gives the transitions that were made."""

import numpy as np
import pandas as pd
import pytest
import yaml
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import Line, build, centred

from sb3_sap import SACAP
from sb3_sap.transitions.sources import batches_of, joined


def whole(source, **options):
    return joined(list(batches_of(source, **options)))


def episodes(n=3, horizon=10):
    """Episodes of random actions on the line: lists of observations, one longer, and of actions and rewards."""
    env = Line(low=-2, high=4)
    env.action_space.seed(0)
    for episode in range(n):
        observations, actions, rewards = [env.reset(seed=episode)[0]], [], []
        for _ in range(horizon):
            actions.append(env.action_space.sample())
            obs, reward, terminated, _, _ = env.step(actions[-1])
            observations.append(obs)
            rewards.append(reward)
        yield np.array(observations), np.array(actions), np.array(rewards), terminated


def expected():
    made = list(episodes())
    return (
        np.concatenate([obs[:-1] for obs, *_ in made]),
        np.concatenate([actions for _, actions, *_ in made]),
        np.concatenate([obs[1:] for obs, *_ in made]),
        np.concatenate([rewards for _, _, rewards, _ in made]),
    )


def check(batch, rewards=True):
    obs, actions, next_obs, paid = expected()
    np.testing.assert_allclose(batch.obs, obs, rtol=1e-6)
    np.testing.assert_allclose(batch.actions.reshape(actions.shape), actions, rtol=1e-6)
    np.testing.assert_allclose(batch.next_obs, next_obs, rtol=1e-6)
    if rewards:
        np.testing.assert_allclose(batch.rewards, paid, rtol=1e-5)
        assert np.flatnonzero(batch.dones).tolist() == [9, 19, 29]


class Trajectory:
    """What `imitation` calls a trajectory."""

    def __init__(self, obs, acts, rews, terminal):
        self.obs, self.acts, self.rews, self.terminal, self.infos = obs, acts, rews, terminal, None


def test_mapping_of_arrays():
    obs, actions, next_obs, rewards = expected()
    dones = np.arange(30) % 10 == 9
    check(whole({"obs": obs, "actions": actions, "next_obs": next_obs, "rewards": rewards, "dones": dones}))


def test_trajectories():
    made = [Trajectory(*episode) for episode in episodes()]
    check(whole(made))
    assert len(whole(made[0])) == 10


def test_trajectory_that_was_cut_off_is_not_terminal():
    (obs, actions, rewards, _), *_ = episodes()
    cut, ended = (whole(Trajectory(obs, actions, rewards, terminal)) for terminal in (False, True))
    assert (cut.dones[-1], cut.truncated[-1]) == (True, True)
    assert (ended.dones[-1], ended.truncated[-1]) == (True, False)


def test_npz_of_imitation(tmp_path):
    """Its version 0.3 joins the arrays and writes where to part them."""
    made = list(episodes())
    np.savez(
        tmp_path / "trajectories.npz",
        obs=np.concatenate([obs for obs, *_ in made]),
        acts=np.concatenate([actions for _, actions, *_ in made]),
        rews=np.concatenate([rewards for _, _, rewards, _ in made]),
        infos=np.array([{} for _ in range(30)]),  # pickled, and never read
        terminal=np.array([False, False, True]),
        indices=np.array([10, 20]),
    )
    batch = whole(tmp_path / "trajectories.npz")
    check(batch)
    assert batch.truncated[[9, 19, 29]].tolist() == [True, True, False]


def test_npz_of_arrays(tmp_path):
    obs, actions, next_obs, _ = expected()
    np.savez(tmp_path / "log.npz", obs=obs, actions=actions, next_obs=next_obs)
    check(whole(str(tmp_path / "log.npz")), rewards=False)


def test_folder_of_imitation(tmp_path):
    """Its version 0.4 and later writes a data set of Hugging Face, which is an Arrow stream."""
    import pyarrow as pa

    rows = [
        {"obs": obs.tolist(), "acts": acts.tolist(), "rews": rews.tolist(), "terminal": bool(end), "infos": ["{}"] * 10}
        for obs, acts, rews, end in episodes()
    ]
    table = pa.Table.from_pylist(rows)
    with (
        pa.OSFile(str(tmp_path / "data-00000-of-00001.arrow"), "wb") as sink,
        pa.ipc.new_stream(sink, table.schema) as w,
    ):
        w.write_table(table)
    check(whole(tmp_path))


def test_minari_data_set(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    buffers = [
        minari.data_collector.EpisodeBuffer(
            id=number,
            observations=obs,
            actions=actions,
            rewards=rewards.tolist(),
            terminations=[False] * 10,
            truncations=[False] * 9 + [True],
        )
        for number, (obs, actions, rewards, _) in enumerate(episodes())
    ]
    env = Line(low=-2, high=4)
    made = minari.create_dataset_from_buffers(
        "line/random-v0", buffers, observation_space=env.observation_space, action_space=env.action_space
    )
    check(whole(made))
    check(whole("line/random-v0"))


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("next_columns", [False, True])
@pytest.mark.parametrize("rows", [4, 10, 20_000])
def test_table(tmp_path, monkeypatch, suffix, next_columns, rows):
    monkeypatch.setattr("sb3_sap.transitions.tables.ROWS", rows)
    obs, actions, next_obs, rewards = expected()
    frame = pd.DataFrame({"x": obs[:, 0], "t": obs[:, 1], "a": actions[:, 0], "r": rewards, "run": np.arange(30) // 10})
    columns = {"obs": ["x", "t"], "actions": "a", "rewards": "r", "episode": "run"}
    if next_columns:
        frame["x2"], frame["t2"] = next_obs.T
        columns["next_obs"] = ["x2", "t2"]
    path = tmp_path / f"log.{suffix}"
    frame.to_csv(path, index=False) if suffix == "csv" else frame.to_parquet(path, row_group_size=7)
    (tmp_path / "columns.yml").write_text(yaml.safe_dump(columns), encoding="utf-8")
    batch = whole(path, columns=tmp_path / "columns.yml")
    if next_columns:
        check(batch)
    else:  # the last step of an episode does not say where it led
        keep = np.arange(30) % 10 < 9
        np.testing.assert_allclose(batch.next_obs, next_obs[keep], rtol=1e-6)
        np.testing.assert_allclose(batch.actions, actions[keep, 0], rtol=1e-6)


def test_table_is_read_piece_by_piece_without_losing_a_step(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_sap.transitions.tables.ROWS", 4)
    frame = pd.DataFrame({"x": np.arange(11.0), "a": np.arange(11.0)})
    frame.to_csv(tmp_path / "log.csv", index=False)
    batches = list(batches_of(tmp_path / "log.csv", {"obs": ["x"], "actions": ["a"]}))
    assert len(batches) == 3
    np.testing.assert_array_equal(joined(batches).obs[:, 0], np.arange(10))
    np.testing.assert_array_equal(joined(batches).next_obs[:, 0], np.arange(1, 11))


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        (None, "needs `columns`"),
        ({"obs": "x"}, "must name those of `actions`"),
        ({"obs": "x", "actions": "pedal"}, "no column 'pedal'"),
        ({"obs": "x", "action": "a"}, "did you mean 'actions'"),
        ({"obs": "word", "actions": "a"}, "not of numbers"),
    ],
)
def test_what_is_wrong_with_columns_is_said(tmp_path, columns, sentence):
    pd.DataFrame({"x": [1.0, 2], "a": [0, 1], "word": ["one", "two"]}).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ValueError, match=sentence):
        whole(tmp_path / "log.csv", columns=columns)


def buffer_of(algorithm, steps, n_envs=1, **settings):
    env = DummyVecEnv([lambda: Line(low=-2, high=4)] * n_envs)
    model = algorithm("MlpPolicy", env, learning_starts=10**6, seed=0, buffer_size=24 * n_envs, **settings)
    model.learn(steps)
    return model


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("steps", [18, 55])
def test_replay_buffer_of_any_algorithm(steps, shared):
    """55 steps are more than it holds; with shared observations the last step of an episode is left out."""
    settings = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    model = buffer_of(SAC, steps, **(settings if shared else {}))
    batch = whole(model.replay_buffer)
    moved = batch.next_obs[:, 0] - batch.obs[:, 0]
    np.testing.assert_allclose(moved, 0.1 * ((batch.actions[:, 0] + 2) / 3 - 1), atol=1e-6)  # in the units of the space
    np.testing.assert_allclose(batch.next_obs[:, 1] - batch.obs[:, 1], 0.1, atol=1e-6)
    if not shared:
        assert len(batch) == min(steps, 24)


def test_replay_buffer_of_several_environments_is_one_after_the_other():
    batch = whole(buffer_of(SAC, 40, n_envs=2).replay_buffer)
    assert len(batch) == 40
    follows = np.isclose(batch.obs[1:, 0], batch.next_obs[:-1, 0])
    assert (follows | batch.dones[:-1] | (np.arange(39) == 19)).all()


def test_file_of_a_replay_buffer(tmp_path):
    model = buffer_of(SAC, 12)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    np.testing.assert_array_equal(whole(tmp_path / "buffer.pkl").obs, whole(model.replay_buffer).obs)


def test_discrete_actions_of_a_replay_buffer():
    model = DQN("MlpPolicy", Line(n_actions=3), learning_starts=10**6, seed=0)
    model.learn(12)
    batch = whole(model.replay_buffer)
    assert batch.actions.shape == (12,)
    np.testing.assert_allclose(batch.next_obs[:, 0] - batch.obs[:, 0], 0.1 * (batch.actions - 1), atol=1e-6)


@pytest.mark.parametrize("settings", [{"penalty": 1.0}, {"penalty": "auto"}, {"potential": centred}])
def test_replay_buffer_with_a_penalty_gives_the_rewards_of_the_environment(settings):
    """Or the penalty would be subtracted twice."""
    model = build(SACAP, **settings, buffer_size=24).learn(30)
    batch = whole(model.replay_buffer)
    np.testing.assert_allclose(batch.rewards, -np.abs(batch.next_obs[:, 0]), atol=1e-5)
    assert (model.replay_buffer.rewards[:, 0] != batch.rewards).any()


@pytest.mark.parametrize(
    ("source", "error", "sentence"),
    [
        (3, ValueError, "A source of transitions is"),
        ("nowhere.csv", FileNotFoundError, "no file nowhere.csv"),
        ("nowhere.npz", FileNotFoundError, "no file nowhere.npz"),
    ],
)
def test_what_is_no_source_is_said(source, error, sentence):
    with pytest.raises(error, match=sentence):
        whole(source, columns={"obs": "x", "actions": "a"})


def test_folder_without_trajectories(tmp_path):
    with pytest.raises(ValueError, match=r"holds no trajectories"):
        whole(tmp_path)


# ------------------------------------------------------------------ what a newcomer's files look like


def test_trailing_commas_do_not_shift_the_columns(tmp_path):
    (tmp_path / "log.csv").write_text("x,t,a,r,z\n1,2,0.3,4,0,\n5,6,0.7,8,0,\n9,1,0.1,2,0,\n", encoding="utf-8")
    batch = whole(tmp_path / "log.csv", columns={"obs": ["x", "t"], "actions": "a", "rewards": "r"})
    np.testing.assert_allclose(batch.obs, [[1, 2], [5, 6]])
    np.testing.assert_allclose(batch.actions, [0.3, 0.7])
    np.testing.assert_allclose(batch.rewards, [4, 8])


@pytest.mark.parametrize("flags", [{"dones": "end", "truncated": "cut"}, {"truncated": "cut"}])
def test_what_was_cut_off_has_ended(tmp_path, flags):
    """Else the next observation of the last step is the first one of the next episode."""
    frame = pd.DataFrame({"x": [1.0, 2, 3, 10, 11], "a": 0.0, "end": 0, "cut": [0, 0, 1, 0, 0]})
    frame.to_csv(tmp_path / "log.csv", index=False)
    batch = whole(tmp_path / "log.csv", columns={"obs": "x", "actions": "a", **flags})
    np.testing.assert_array_equal(batch.next_obs - batch.obs, [1, 1, 1])


def test_several_columns_may_tell_the_episode(tmp_path):
    frame = pd.DataFrame({"x": [1.0, 2, 10, 11], "a": 0.0, "driver": "me", "run": [1, 1, 2, 2]})
    frame.to_csv(tmp_path / "log.csv", index=False)
    columns = {"obs": "x", "actions": "a", "episode": ["driver", "run"]}
    assert whole(tmp_path / "log.csv", columns=columns).next_obs.tolist() == [2, 11]


def test_flag_that_is_neither_true_nor_false_is_an_error_with_episodes_too(tmp_path):
    pd.DataFrame({"x": [1.0, 2, 3], "a": 0.0, "d": [0, 2, np.nan], "run": 1}).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ValueError, match="`dones` must be True or False"):
        whole(tmp_path / "log.csv", columns={"obs": "x", "actions": "a", "dones": "d", "episode": "run"})


@pytest.mark.parametrize("more", [{}, {"episode": "run"}, {"next_obs": "y"}])
def test_table_without_rows_gives_nothing(tmp_path, more):
    (tmp_path / "log.csv").write_text("x,a,y,run\n", encoding="utf-8")
    assert list(batches_of(tmp_path / "log.csv", {"obs": "x", "actions": "a", **more})) == []


def test_flag_in_a_list_of_one_column(tmp_path):
    frame = pd.DataFrame({"x": [1.0, 2, 3], "a": 0.0, "d": [0, 1, 0], "run": 1})
    frame.to_csv(tmp_path / "log.csv", index=False)
    columns = {"obs": ["x"], "actions": ["a"], "dones": ["d"], "episode": ["run"]}
    assert whole(tmp_path / "log.csv", columns=columns).obs.tolist() == [[1.0]]


@pytest.mark.parametrize(
    ("name", "content"),
    [("log.csv", b""), ("log.parquet", b"PAR1"), ("log.npz", b"PK"), ("log.pkl", b"x"), ("log.pkl.gz", b"x")],
)
def test_broken_file_is_one_sentence_with_its_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name.replace(".", r"\.")) as error:
        whole(tmp_path / name, columns={"obs": "x", "actions": "a"})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("columns", [{"obs": 3, "actions": "a"}, {"obs": "x", "actions": "a", "episode": None}])
def test_columns_are_named_by_text(tmp_path, columns):
    (tmp_path / "log.csv").write_text("x,a\n1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must name the columns of"):
        whole(tmp_path / "log.csv", columns=columns)


def test_broken_yaml_is_one_sentence(tmp_path):
    (tmp_path / "log.csv").write_text("x,a\n1,2\n", encoding="utf-8")
    (tmp_path / "columns.yml").write_text("obs: [x\nactions: }", encoding="utf-8")
    with pytest.raises(ValueError, match=r"columns\.yml is no YAML") as error:
        whole(tmp_path / "log.csv", columns=tmp_path / "columns.yml")
    assert "\n" not in str(error.value)
