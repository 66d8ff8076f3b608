"""Whole episodes: trajectories as `imitation` has and writes them, and data sets of Minari."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_sap.common.arrays import rows_of
from sb3_sap.transitions.batch import Transitions


def is_episodes(source: Any) -> bool:
    """Whether a source is a Minari data set, a trajectory, or a sequence of trajectories."""
    if hasattr(source, "iterate_episodes") or _is_trajectory(source):
        return True
    return isinstance(source, Sequence) and bool(source) and all(map(_is_trajectory, source))


def _is_trajectory(value: Any) -> bool:
    return all(hasattr(value, name) for name in ("obs", "acts", "terminal"))


def episodes_of(source: Any) -> Iterator[Transitions]:
    """The transitions of each episode.

    :param source: what `is_episodes` accepts, the folder of a data set of `imitation`, or an iterator of episodes
    """
    if hasattr(source, "iterate_episodes"):
        for episode in source.iterate_episodes():
            ended = np.asarray(episode.terminations, dtype=bool)
            cut = np.asarray(episode.truncations, dtype=bool) & ~ended
            yield _episode(episode.observations, episode.actions, episode.rewards, ended | cut, cut)
    elif isinstance(source, Path):
        yield from _folder(source)
    elif _is_trajectory(source):
        yield from episodes_of([source])
    else:
        for one in source:
            yield (
                one
                if isinstance(one, Transitions)
                else _trajectory(one.obs, one.acts, one.terminal, getattr(one, "rews", None))
            )


def _trajectory(obs: Any, acts: Any, terminal: Any, rewards: Any) -> Transitions:
    """An episode whose last step ended it, or cut it off if ``terminal`` is False."""
    acts = np.asarray(acts)
    last = np.zeros(len(acts), dtype=bool)
    last[-1:] = True
    return _episode(obs, acts, rewards, last, last & (not bool(terminal)))


def _episode(obs: Any, actions: Any, rewards: Any, dones: Any, truncated: Any) -> Transitions:
    """An episode of n steps with n + 1 observations."""
    obs = getattr(obs, "_d", obs)  # imitation's DictObs
    obs = {key: np.asarray(one) for key, one in obs.items()} if isinstance(obs, Mapping) else np.asarray(obs)
    actions = np.asarray(actions)
    lengths = [len(one) for one in (obs.values() if isinstance(obs, dict) else [obs])]
    if any(length != len(actions) + 1 for length in lengths):
        raise ValueError(
            f"An episode of {len(actions)} actions must have {len(actions) + 1} observations, the last one included, "
            f"but has {lengths[0]}."
        )
    rewards = None if rewards is None else np.asarray(rewards, dtype=np.float32)
    return Transitions(
        rows_of(obs, slice(None, -1)), actions, rows_of(obs, slice(1, None)), rewards, np.asarray(dones), truncated
    )


def npz_episodes(arrays: Mapping[str, Any]) -> Iterator[Transitions]:
    """Trajectories of the ``.npz`` that `imitation` 0.3 and older writes: joined arrays, and where to part them."""
    cuts, terminal = arrays["indices"], arrays["terminal"]
    acts = np.split(arrays["acts"], cuts)
    obs = np.split(arrays["obs"], cuts + np.arange(len(cuts)) + 1)
    rewards = np.split(arrays["rews"], cuts) if "rews" in arrays else [None] * len(acts)
    for parts in zip(obs, acts, terminal, rewards, strict=True):
        yield _trajectory(*parts)


def _folder(folder: Path) -> Iterator[Transitions]:
    """Trajectories of the folder that `imitation` 0.4 and newer writes: a Hugging Face data set with a row for each."""
    files = sorted(folder.glob("*.arrow"))
    if not files:
        raise ValueError(f"{folder}/ holds no trajectories: `imitation` writes .arrow files there.")
    try:
        import pyarrow as pa
    except ModuleNotFoundError as error:
        raise ValueError(f"{folder}/ holds .arrow files, which need: pip install 'sb3-sap[logs]'.") from error
    for file in files:
        with pa.memory_map(str(file)) as source, pa.ipc.open_stream(source) as stream:
            for batch in stream:
                known = [name for name in ("obs", "acts", "terminal", "rews") if name in batch.schema.names]
                if len(known) < 3:
                    raise ValueError(f"{file} holds no trajectories: it has no `obs`, `acts` and `terminal`.")
                for row in batch.select(known).to_pylist():
                    yield _trajectory(row["obs"], row["acts"], row["terminal"], row.get("rews"))
