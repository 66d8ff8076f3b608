"""Snapshots of a training in progress, from which a run that was killed continues to the same result.

A snapshot holds the model, the filled part of its replay buffer, all random generators, what was recorded, and every
action that was executed. The environment is not saved, because a simulator need not be able to: it is brought back to
its state by a reset with the same seed and the same actions, which takes no learning.
"""

from __future__ import annotations

import io
import pickle
import random
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.recorder import Clock, Recorder
from sb3_sap.common.arrays import same_observation
from sb3_sap.common.files import atomic_path

#: s between two snapshots.
INTERVAL = 300.0
#: Attributes of a replay buffer that belong to the model or to its environment.
OF_THE_MODEL = ("env", "ap_function", "event", "shaping", "observation_space", "action_space", "device")


class SnapshotCallback(BaseCallback):
    """Writes a snapshot every few minutes, between two rollouts.

    :param path: where to write it
    :param recorder: what records the run
    :param clock: is stopped while a snapshot is written
    """

    model: Any

    def __init__(self, path: Path, recorder: Recorder, clock: Clock):
        super().__init__()
        self.actions: list[Any] = []
        self._path, self._recorder, self._clock = path, recorder, clock
        self._written = time.monotonic()
        #: The states of generators with which the training begins; None: those that it has.
        self.generators: Mapping[str, Any] | None = None

    def _on_training_start(self) -> None:
        if self.generators is not None:
            restore_generators(self.model, self.generators)

    def _on_step(self) -> bool:
        self.actions.append(np.copy(self.locals["actions"]))
        return True

    def _on_rollout_start(self) -> None:
        if time.monotonic() - self._written >= INTERVAL and self.actions:
            with self._clock.stopped():
                self.write()
            self._written = time.monotonic()

    def write(self) -> None:
        """Writes the snapshot, atomically."""
        model, file = self.model, io.BytesIO()
        model.save(file)
        snapshot = {
            "code": code(),
            "model": file.getvalue(),
            "replay_buffer": filled_part(model.replay_buffer),
            "generators": generators(model),
            "recorded": self._recorder.state(),
            "clock": self._clock.state(),
            "actions": np.stack(self.actions),
        }
        with atomic_path(self._path) as temporary:
            temporary.write_bytes(pickle.dumps(snapshot))


def resume(path: Path, model: Any, callback: SnapshotCallback, recorder: Recorder, clock: Clock) -> Any:
    """The model of a snapshot, with its environment, buffers and generators as they were; ``model`` if there is none.

    A snapshot that cannot be read, that other code wrote, or whose environment does not come back to the same
    observation is deleted: the run then begins anew.

    :param path: of the snapshot
    :param model: as it is before the training, with the environment in which it will learn
    :param callback: gets the actions that were executed
    :param recorder: gets what was recorded
    :param clock: goes on from where it was
    """
    try:
        snapshot = pickle.loads(path.read_bytes())
    except FileNotFoundError:
        return model
    except Exception:  # whatever pickle raises for a damaged file
        path.unlink()
        return model
    if snapshot["code"] != code():
        path.unlink()
        return model
    loaded = type(model).load(io.BytesIO(snapshot["model"]), env=model.env, device="cpu", force_reset=False)
    observed = replay(loaded.env, snapshot["actions"])
    if not same_observation(observed, loaded._last_obs):  # a simulator that is not deterministic
        path.unlink()
        return model
    fill(loaded.replay_buffer, snapshot["replay_buffer"])
    recorder.restore(snapshot["recorded"])
    clock.restore(snapshot["clock"])
    callback.actions = list(snapshot["actions"])
    callback.generators = snapshot["generators"]
    return loaded


def code() -> dict[str, Any]:
    """The versions and the revision, without which a run is not the same."""
    made = provenance()
    return {name: made[name] for name in ("versions", "revision")}


def replay(env: Any, actions: Any) -> Any:
    """Resets a vectorised environment that was seeded, executes actions, and returns the last observations."""
    obs = env.reset()
    for action in actions:
        obs = env.step(action)[0]
    return obs


def filled_part(buffer: Any) -> dict[str, Any]:
    """The attributes of a replay buffer, with only the filled rows of its arrays."""
    n = buffer.buffer_size if buffer.full else buffer.pos

    def part(value: Any) -> Any:
        if isinstance(value, np.ndarray) and len(value) == buffer.buffer_size:
            return value[:n]
        if isinstance(value, Mapping):
            return {key: part(entry) for key, entry in value.items()}
        return value

    return {name: part(value) for name, value in vars(buffer).items() if name not in OF_THE_MODEL}


def fill(buffer: Any, attributes: Mapping[str, Any]) -> None:
    """Writes what :func:`filled_part` returned into an empty buffer of the same size."""

    n = buffer.buffer_size if attributes["full"] else attributes["pos"]

    def write(own: Any, saved: Any) -> Any:
        if own is None and isinstance(saved, np.ndarray) and len(saved) == n:  # the buffer makes it with its first row
            own = np.zeros((buffer.buffer_size, *saved.shape[1:]), saved.dtype)
        if isinstance(own, np.ndarray) and isinstance(saved, np.ndarray) and len(own) == buffer.buffer_size:
            own[: len(saved)] = saved
            return own
        if isinstance(own, Mapping) and isinstance(saved, Mapping) and own.keys() == saved.keys():
            return {key: write(own[key], saved[key]) for key in own}
        return saved

    for name, saved in attributes.items():
        setattr(buffer, name, write(getattr(buffer, name, None), saved))


def generators(model: Any) -> dict[str, Any]:
    """The states of all random generators but those that the model and its buffers save themselves."""
    return {
        "torch": th.get_rng_state(),
        "numpy": np.random.get_state(),  # noqa: NPY002  # SB3 draws from it
        "random": random.getstate(),
        "action_space": model.action_space.np_random.bit_generator.state,
        "action_noise": model.action_noise,  # which `learn` resets
    }


def restore_generators(model: Any, states: Mapping[str, Any]) -> None:
    """Brings the generators back to the states of :func:`generators`."""
    th.set_rng_state(states["torch"])
    np.random.set_state(states["numpy"])  # noqa: NPY002
    random.setstate(states["random"])
    model.action_space.np_random.bit_generator.state = states["action_space"]
    model.action_noise = states["action_noise"]
