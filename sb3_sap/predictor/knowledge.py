"""The knowledge buffer K of labelled actions (section 4.2)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sap.common.arrays import FloatArray, Observations, copy_observation, joined_rows, rows_of
from sb3_sap.common.errors import is_number
from sb3_sap.common.files import atomic_path
from sb3_sap.common.random import make_rng
from sb3_sap.predictor.slots import ClassSlots, Reservoir

NON_PERMISSIBLE, PERMISSIBLE = 0, 1
CLASSES = (NON_PERMISSIBLE, PERMISSIBLE)
#: Maximum number of observations among which the typical one is sought.
TYPICAL = 1_000
Part = Literal["train", "validation"]
PARTS: tuple[Part, Part] = ("train", "validation")


class LabelledActions(NamedTuple):
    """A sample of K: n rows, of which half are permissible if it is balanced."""

    observations: Observations  # (n, *obs_shape)
    actions: np.ndarray[Any, Any]  # (n, action_dim), scaled to [-1, 1]
    labels: FloatArray  # (n,) 1 where permissible, else 0; with labels per part of the action (n, k), NaN: not known


class KnowledgeBuffer:
    """K: a finite store of (s, a, l(a)), split into training and validation examples (sections 4.2 and 5.1).

    Observations are kept raw, as SB3's replay buffer keeps them, and normalised when sampled.

    What is known from elsewhere is held apart, in `prior`, and makes up ``prior_share`` of each sample.

    :param observation_space: of the environment
    :param action_dim: length of one stored action
    :param size: capacity; the paper's is 10,000
    :param validation_fraction: share kept for validation; the paper's 9:1 is 0.1
    :param seed: of the generator that splits and samples
    :param min_per_class: tuples of each class, in each part, for which a full K makes room at the other class's cost
    """

    #: The parts of the action that have labels of their own; none: a label is of the whole action.
    part_names: tuple[str, ...] = ()
    #: Tuples of each class that a part must have before it is used beside `prior`.
    min_per_class: int = 1
    #: What is known from elsewhere; None: nothing.
    prior: PriorKnowledge | None = None
    #: The share of a sample that comes from `prior`, once there are enough own tuples of both classes.
    prior_share: float = 0.5
    #: The newest labelled actions, for whoever tests E on them before it learns from them; None: nobody does.
    newest: list[tuple[Observations, np.ndarray[Any, Any], np.ndarray[Any, Any]]] | None = None

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_dim: int,
        size: int = 10_000,
        validation_fraction: float = 0.1,
        seed: int | None = None,
        min_per_class: int = 1,
    ):
        if not (is_number(validation_fraction) and 0 < validation_fraction < 1):
            raise ValueError(f"`validation_fraction` must lie between 0 and 1, but is {validation_fraction!r}.")
        n_validation = round(size * validation_fraction)
        if min(n_validation, size - n_validation) < 2:
            raise ValueError(
                f"`knowledge_buffer_size` = {size} with `validation_fraction` = {validation_fraction} leaves no room "
                "for both classes in each part: both the training and the validation part need at least 2 places."
            )
        self.size = size
        self.min_per_class = min_per_class
        self.validation_fraction = validation_fraction
        self.seed(seed)
        self.seen = [0, 0]  # (non-permissible, permissible) tuples ever added
        capacities = {"train": size - n_validation, "validation": n_validation}
        self.parts: dict[str, Any] = {
            part: ClassSlots(capacity, min_per_class) for part, capacity in capacities.items()
        }
        # The validation part lies behind the training part in the same arrays.
        self._offset = {"train": 0, "validation": size - n_validation}
        self._keyed = isinstance(observation_space, spaces.Dict)
        keyed_spaces = (
            observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        )
        self.observations = {k: np.zeros((size, *(s.shape or ())), s.dtype) for k, s in keyed_spaces.items()}
        self.actions = np.zeros((size, action_dim), dtype=np.float32)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts.values())

    def __getstate__(self) -> dict[str, Any]:
        """For pickle: of the arrays only the filled rows."""
        filled = self._filled()
        rows = {key: store[filled] for key, store in self.observations.items()}
        return {**vars(self), "observations": rows, "actions": self.actions[filled]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.observations = {key: self._whole(rows) for key, rows in self.observations.items()}
        self.actions = self._whole(self.actions)

    def _whole(self, rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """An array of all rows, of which the filled ones are given."""
        if len(rows) == self.size:  # every row is filled, or an earlier version wrote all rows
            return rows
        store = np.zeros((self.size, *rows.shape[1:]), rows.dtype)
        store[self._filled()] = rows
        return store

    def save(self, path: str | Path) -> None:
        """Writes K as SB3 writes a replay buffer, with pickle; only its filled rows take space."""
        with atomic_path(Path(path)) as temporary:
            save_to_pkl(temporary, self)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads what :meth:`save` wrote, which runs code that the file contains: load only files that you trust."""
        loaded = load_from_pkl(path)
        if not isinstance(loaded, cls):
            raise TypeError(f"{path} holds no knowledge buffer but a {type(loaded).__name__}.")
        return loaded

    def _filled(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        """The rows that hold a tuple."""
        kept = [self._offset[part] + self.parts[part].slots(label) for part in PARTS for label in CLASSES]
        return np.sort(np.concatenate(kept))

    def seed(self, seed: int | None) -> None:
        """Restarts the generator that splits and samples."""
        self.rng = make_rng(seed, "knowledge")

    def counts(self, part: Part) -> tuple[int, int]:
        """Number of (non-permissible, permissible) tuples in a part."""
        non_permissible, permissible = self.parts[part].counts
        return non_permissible, permissible

    def add(self, obs: Observations, actions: np.ndarray[Any, Any], labels: np.ndarray[Any, Any]) -> Any:
        """Adds n labelled actions.

        :param obs: (n, *obs_shape), raw
        :param actions: (n, action_dim), scaled
        :param labels: (n,) bool
        :return: (n,) the rows that they took, of which a later one may have taken an earlier one's
        """
        if self.newest is not None:
            self.newest.append((copy_observation(obs), actions.copy(), labels))
        keyed = obs if isinstance(obs, dict) else {"": obs}
        slots = np.zeros(len(labels), dtype=np.int64)
        for i, label in enumerate(labels):
            part: Part = "validation" if self.rng.random() < self.validation_fraction else "train"
            slots[i] = slot = self._offset[part] + self.parts[part].claim(int(label))
            for key, store in self.observations.items():
                store[slot] = keyed[key][i]
            self.actions[slot] = actions[i]
            self.seen[int(label)] += 1
        return slots

    def holds(self, part: Part, n: int) -> bool:
        """Whether a part, or that of `prior`, has n tuples of each class."""
        own = min(self.counts(part)) >= n
        return own or (self.prior is not None and self.prior.holds(part, n))

    def training_observations(self) -> dict[str, np.ndarray[Any, Any]]:
        """The raw observations of the training part, (n, *obs_shape) for each key; an array's key is ``""``."""
        slots = np.concatenate([self.parts["train"].slots(label) for label in CLASSES])
        return {key: store[slots] for key, store in self.observations.items()}

    def typical_observation(self) -> Any:
        """The raw observation in K that lies nearest to the median of all; ``None`` if K is empty.

        The median itself may be an impossible state, for example of the sine and cosine of an angle.
        """
        observed = self.training_observations()
        n = len(next(iter(observed.values())))
        if n == 0:
            return None
        few = {key: rows[:: math.ceil(n / TYPICAL)] for key, rows in observed.items()}
        distance = np.zeros(len(next(iter(few.values()))))
        for observations in few.values():
            rows = observations.reshape(len(observations), -1).astype(np.float64)
            spread = rows.std(axis=0)
            distance += (np.abs(rows - np.median(rows, axis=0)) / np.where(spread > 0, spread, 1)).sum(axis=1)
        row = {key: rows[distance.argmin()].copy() for key, rows in few.items()}
        return row if self._keyed else row[""]

    def sample(
        self, n: int, part: Part = "train", env: VecNormalize | None = None, balanced: bool = True
    ) -> LabelledActions:
        """Draws a balanced D_E: n // 2 tuples of each class, with replacement, in random order.

        :param n: N_E; an odd number is rounded down
        :param part: the part of K to draw from
        :param env: normalises the observations, if given
        :param balanced: False draws every tuple with the same probability
        """
        from_prior = self._from_prior(n, part)
        if from_prior == 0:
            return self.sample_own(n, part, env, balanced)
        assert self.prior is not None
        older = self.prior.sample_own(from_prior, part, env, balanced)
        if from_prior >= 2 * (n // 2):
            return older
        newer = self.sample_own(n - from_prior, part, env, balanced)
        order = self.rng.permutation(len(older.labels) + len(newer.labels))
        joined = [rows_of(joined_rows([old, new]), order) for old, new in zip(older, newer, strict=True)]
        return LabelledActions(*joined)

    def _from_prior(self, n: int, part: Part) -> int:
        """How many of n rows come from `prior`, an even number."""
        if self.prior is None or not self.prior.holds(part, 1):
            return 0
        enough = min(self.counts(part)) >= self.min_per_class
        return 2 * round(n // 2 * (self.prior_share if enough else 1.0))

    def sample_own(
        self, n: int, part: Part = "train", env: VecNormalize | None = None, balanced: bool = True
    ) -> LabelledActions:
        """The same without `prior`."""
        return self._labelled(part, *self._draw(n, part, balanced), env)

    def _draw(self, n: int, part: Part, balanced: bool = True) -> tuple[Any, FloatArray]:
        """Rows of a part, counted from its first, and their labels."""
        n_permissible = n // 2
        if not balanced:
            n_permissible = int(self.rng.binomial(2 * (n // 2), self.counts(part)[PERMISSIBLE] / len(self.parts[part])))
        sizes = (2 * (n // 2) - n_permissible, n_permissible)
        chosen = [self.rng.choice(self.parts[part].slots(label), k) for label, k in enumerate(sizes) if k > 0]
        labels = np.repeat(np.array(CLASSES, dtype=np.float32), sizes)
        order = self.rng.permutation(len(labels))
        return np.concatenate(chosen)[order], labels[order]

    def sample_class(
        self, label: int, n: int, part: Part = "train", env: VecNormalize | None = None
    ) -> LabelledActions:
        """n tuples of one class, without `prior`, with replacement."""
        chosen = self.rng.choice(self.parts[part].slots(label), n)
        return self._labelled(part, chosen, np.full(n, label, dtype=np.float32), env)

    def _labelled(self, part: Part, slots: Any, labels: FloatArray, env: VecNormalize | None) -> LabelledActions:
        slots = self._offset[part] + slots
        rows = {key: store[slots] for key, store in self.observations.items()}
        obs: Observations = rows if self._keyed else rows[""]
        return LabelledActions(obs if env is None else env.normalize_obs(obs), self.actions[slots], labels)


class PriorKnowledge(KnowledgeBuffer):
    """What is known from elsewhere: a balanced random sample of all labelled actions that it was ever given.

    The parameters are those of :class:`KnowledgeBuffer`. Half of each part is for each class.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.parts = {name: Reservoir(part.capacity) for name, part in self.parts.items()}

    def seed(self, seed: int | None) -> None:
        self.rng = make_rng(seed, "prior")

    def add(self, obs: Observations, actions: np.ndarray[Any, Any], labels: np.ndarray[Any, Any]) -> None:
        keyed = obs if isinstance(obs, dict) else {"": obs}
        validates = self.rng.random(len(labels)) < self.validation_fraction
        for part in PARTS:
            for label in CLASSES:
                rows = np.flatnonzero((labels == label) & (validates == (part == "validation")))
                kept, slots = self.parts[part].claim(label, len(rows), self.rng)
                slots = self._offset[part] + slots
                for key, store in self.observations.items():
                    store[slots] = keyed[key][rows[kept]]
                self.actions[slots] = actions[rows[kept]]
                self.seen[label] += len(rows)
