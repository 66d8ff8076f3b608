"""Reads transitions of any kind of source, batch by batch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl

from sb3_sap.common.arrays import joined_rows, rows_of
from sb3_sap.common.spaces import unscaled
from sb3_sap.common.vec_envs import environment_layout
from sb3_sap.transitions.batch import NAMES, Transitions, readable, transitions_of
from sb3_sap.transitions.episodes import episodes_of, is_episodes, npz_episodes
from sb3_sap.transitions.tables import TABLES, Columns, table_batches

#: Rows that are read at a time.
ROWS = 20_000


def batches_of(source: Any, columns: Columns | None = None, images: tuple[str, ...] = ()) -> Iterator[Transitions]:
    """Reads a source.

    :param source: :class:`~sb3_sap.transitions.batch.Transitions` or a mapping of such arrays; a replay buffer of SB3
        or its ``.pkl``; a Minari data set or its id; trajectories as `imitation` has them, their ``.npz`` or their
        folder; a ``.csv`` or ``.parquet`` table, or several
    :param columns: what the columns of a table hold, or the YAML file that says so
    :param images: of a replay buffer of the same environment, the images that are stored channels first
    :raise ValueError: if it is none of these
    :raise FileNotFoundError: if there is no such file
    """
    if isinstance(source, ReplayBuffer):
        return buffer_batches(source, images)
    if isinstance(source, Transitions):
        return _parts(transitions_of(source.arrays()))
    if isinstance(source, Mapping):
        return _parts(transitions_of(source))
    if is_episodes(source):
        return _episode_batches(source)
    if isinstance(source, (str, Path)):
        return _file_batches(source, columns, images)
    if isinstance(source, Sequence) and source and all(isinstance(one, (str, Path)) for one in source):
        return (batch for one in source for batch in _file_batches(one, columns, images))
    raise ValueError(
        f"A source of transitions is a mapping with `obs`, `actions` and `next_obs`, a replay buffer, a Minari data "
        f"set, trajectories, or the name of a file, but not {type(source).__name__}."
    )


def number_of_rows(source: Any) -> int | None:
    """The number of transitions of a source, if it is known before it is read."""
    if isinstance(source, ReplayBuffer):
        return source.size() * source.n_envs
    if isinstance(source, Mapping) and "actions" in source:
        return len(source["actions"])
    return len(source) if isinstance(source, Transitions) else None


def _file_batches(source: str | Path, columns: Columns | None, images: tuple[str, ...]) -> Iterator[Transitions]:
    path = Path(source)
    if path.name.endswith(TABLES):
        return table_batches(path, columns)
    if not path.exists():
        if isinstance(source, str) and _is_minari_id(source):
            return _episode_batches(_minari(source))
        raise FileNotFoundError(f"There is no file {source}.")
    if path.suffix == ".npz":
        return _npz_batches(path)
    if path.is_dir():
        return _episode_batches(path)
    if path.suffix == ".pkl":
        with readable(path):
            loaded = load_from_pkl(path)
        if not isinstance(loaded, ReplayBuffer):
            raise ValueError(f"{path} holds no replay buffer of SB3 but a {type(loaded).__name__}.")
        return buffer_batches(loaded, images)
    raise ValueError(
        f"{path} is of no known kind: give a .csv or .parquet table, an .npz of arrays or of trajectories, a .pkl of a "
        "replay buffer, or a folder of trajectories."
    )


def _npz_batches(path: Path) -> Iterator[Transitions]:
    with readable(path):
        file = np.load(path)
    with file as arrays:
        if "acts" in arrays.files:
            yield from _episode_batches(npz_episodes(arrays))
        else:
            yield from _parts(transitions_of({name: arrays[name] for name in arrays.files}))


def _is_minari_id(text: str) -> bool:
    name, _, version = text.rpartition("-v")
    return bool(name) and version.isdecimal()


def _minari(name: str) -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ValueError(f"{name} is a Minari data set, which needs: pip install 'sb3-sap[logs]'.") from error
    with readable(name):
        return minari.load_dataset(name, download=True)


def _parts(transitions: Transitions) -> Iterator[Transitions]:
    for start in range(0, len(transitions), ROWS):
        yield transitions.rows(slice(start, start + ROWS))


def _episode_batches(source: Any) -> Iterator[Transitions]:
    """Episodes joined to batches, so that a thousand short ones are not a thousand batches."""
    pending: list[Transitions] = []
    for episode in episodes_of(source):
        pending.append(episode)
        if sum(map(len, pending)) >= ROWS:
            yield joined(pending)
            pending = []
    if pending:
        yield joined(pending)


def joined(parts: list[Transitions]) -> Transitions:
    """Several batches in one; an array that one of them lacks, all lack."""

    def join(values: list[Any]) -> Any:
        return None if any(value is None for value in values) else joined_rows(values)

    return Transitions(**{name: join([getattr(part, name) for part in parts]) for name in NAMES})


def buffer_batches(buffer: ReplayBuffer, images: tuple[str, ...] = ()) -> Iterator[Transitions]:
    """The transitions of a replay buffer of any algorithm, environment by environment, oldest first.

    SB3 scales the actions of a ``Box`` to [-1, 1]. With ``optimize_memory_usage`` the next observation of a row is the
    observation of the next row, so that that of an episode's last step is lost: those rows are left out. Of
    rewards with a penalty or a potential it gives those of the environment.
    """
    size, start = buffer.size(), buffer.pos if buffer.full else 0
    order = (start + np.arange(size)) % buffer.buffer_size
    shared = buffer.optimize_memory_usage
    added = getattr(buffer, "added", None)
    for env in range(buffer.n_envs):
        for begin in range(0, size, ROWS):
            rows = order[begin : begin + ROWS]
            if shared:  # the newest next observation has taken the place of the oldest observation
                rows = rows[~(buffer.dones[rows, env].astype(bool) | (buffer.full & (rows == buffer.pos)))]
            obs = rows_of(buffer.observations, (rows, env))
            if shared:
                next_obs = rows_of(buffer.observations, ((rows + 1) % buffer.buffer_size, env))
            else:
                next_obs = rows_of(buffer.next_observations, (rows, env))
            actions = buffer.actions[rows, env].reshape(-1, *(buffer.action_space.shape or ()))
            timeouts = getattr(buffer, "timeouts", np.zeros_like(buffer.dones))
            yield Transitions(
                environment_layout(obs, images),
                unscaled(buffer.action_space, actions),
                environment_layout(next_obs, images),
                buffer.rewards[rows, env] - (0.0 if added is None else added[rows, env]),
                buffer.dones[rows, env].astype(bool),
                timeouts[rows, env].astype(bool),
            )
