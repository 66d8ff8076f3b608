"""A run that was killed continues from its snapshot, and ends as if it had not been."""

import time

import pytest

from sb3_sap.benchmark import snapshots
from sb3_sap.benchmark.configurations import parse_configuration
from sb3_sap.benchmark.runs import make_run
from sb3_sap.benchmark.training import train_and_evaluate

STEPS, SAVED, KILLED = 140, 116, 128  # multiples of four, the train frequency below


class Killed(Exception):
    """Stands for the end of the process."""


def tables(run, snapshot=None):
    """The tables of a run but its times."""
    result = train_and_evaluate(run, time.monotonic(), snapshot)
    assert [len(row) for row in result.pop("times")["data"]] == [4] * len(run.checkpoints)
    return result


def kill(monkeypatch):
    """Lets a training write a snapshot before one step, and end in another."""
    real = snapshots.SnapshotCallback._on_rollout_start

    def rollout(self):
        monkeypatch.setattr(snapshots, "INTERVAL", 0.0 if self.num_timesteps == SAVED else 1e9)
        real(self)
        if self.num_timesteps >= KILLED:
            raise Killed

    monkeypatch.setattr(snapshots.SnapshotCallback, "_on_rollout_start", rollout)


def make(configuration, task="highway", tracks=("eroad",)):
    return make_run(parse_configuration(configuration), task, STEPS, 0, tracks)


@pytest.mark.parametrize(
    ("configuration", "task"),
    [
        ("ddpg_ap:fast", "highway"),
        pytest.param("ddpg_ap:paper", "highway", marks=pytest.mark.slow),  # with a noise process
        pytest.param("tqc", "highway", marks=pytest.mark.slow),
        pytest.param("sac_ap:default[n_steps=3,penalty=2.0]", "highway", marks=pytest.mark.slow),
        ("dqn_ap:task[learning_starts=50,train_freq=4]", "MountainCar-v0"),
    ],
)
def test_killed_run_continues_to_the_same_result(configuration, task, tmp_path, monkeypatch):
    run = make(configuration, task, ("eroad",) if task == "highway" else ("10000",))
    whole, path = tables(run), tmp_path / "runs" / "run.snapshot"
    with monkeypatch.context() as patched:
        kill(patched)
        with pytest.raises(Killed):
            tables(run, path)
    assert path.exists()
    trained = []
    with monkeypatch.context() as patched:
        start = snapshots.SnapshotCallback._on_training_start
        patched.setattr(
            snapshots.SnapshotCallback,
            "_on_training_start",
            lambda self: (trained.append(self.num_timesteps), start(self)),
        )
        assert tables(run, path) == whole
    assert trained == [SAVED]
    assert not path.exists()


@pytest.mark.parametrize("damage", ["truncated", "other code", "other environment"])
def test_unusable_snapshot_is_deleted_and_the_run_begins_anew(damage, tmp_path, monkeypatch):
    run, path = make("ddpg"), tmp_path / "run.snapshot"
    with monkeypatch.context() as patched:
        kill(patched)
        with pytest.raises(Killed):
            tables(run, path)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:-100])
    elif damage == "other code":
        monkeypatch.setattr(snapshots, "code", lambda: {"revision": "another"})
    else:
        real = snapshots.replay
        monkeypatch.setattr(snapshots, "replay", lambda env, actions: real(env, actions) + 1)
    trained = []
    start = snapshots.SnapshotCallback._on_training_start
    monkeypatch.setattr(
        snapshots.SnapshotCallback, "_on_training_start", lambda self: (trained.append(self.num_timesteps), start(self))
    )
    assert tables(run, path)["curve"]["data"]
    assert trained == [0]
    assert not path.exists()
