"""Transitions from elsewhere in replay buffers beside the model's own, in the order in which they happened."""

from __future__ import annotations

import copy
from typing import Any, cast

import numpy as np
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.common.arrays import BoolArray, joined_rows, rows_of
from sb3_sap.common.vec_envs import environment_layout
from sb3_sap.predictor.buffers import KnowledgeMixin
from sb3_sap.predictor.building import make_replay_buffer
from sb3_sap.transitions.batch import Transitions

#: Rows of one buffer, where it is not known how many there are.
ROWS = 100_000


class PriorReplay:
    """Fills new buffers of the kind of a model's own, which `attach` adds to it at the end.

    :param model: an off-policy model
    :param required: whether transitions without rewards are an error; else none are taken
    :param rows: how many transitions there are; None: unknown
    """

    def __init__(self, model: Any, required: bool, rows: int | None):
        self.model = model
        self.required = required
        self.size = rows or ROWS
        self.rows = 0
        self._own = cast(KnowledgeMixin, model.replay_buffer)
        self._scale = copy.copy(self._own.reward_scale)
        self._buffers: list[KnowledgeMixin] = []
        self._pieces = 0
        self._last: Any = None  # a step whose successor is not known yet

    def extend(
        self, batch: Transitions, sound: BoolArray, scaled: np.ndarray[Any, Any], labels: BoolArray | None
    ) -> None:
        """Takes in the sound rows of a batch.

        :param scaled: (n, *action_shape) actions
        :raise ValueError: if it has no rewards
        """
        if batch.rewards is None and not self.required:
            return
        if batch.rewards is None:
            raise ValueError(
                "The replay buffer needs rewards, which these transitions do not have: give them, or use "
                '`into="knowledge"`.'
            )
        if not sound.any():
            return
        batch, scaled = batch.rows(sound), scaled[sound]
        labels = None if labels is None else labels[sound]
        rewards = np.asarray(batch.rewards, dtype=np.float64)
        dones = np.zeros(len(batch), bool) if batch.dones is None else batch.dones
        truncated = np.zeros(len(batch), bool) if batch.truncated is None else batch.truncated & dones
        self._scale.update(rewards)
        if self._own.shaping:
            before, after = (environment_layout(side, self._own.images) for side in (batch.obs, batch.next_obs))
            terminal = dones & ~truncated
            rewards = rewards + self._own.shaping.difference(labels, before, after, terminal, float(self._scale))
        steps = (batch.obs, batch.next_obs, scaled, rewards, dones, truncated)
        if self._last is not None:
            steps = tuple(joined_rows([old, new]) for old, new in zip(self._last, steps, strict=True))
        # What is followed by another state than it led to was cut off there, for what reads steps in their order.
        broken = _differ(rows_of(steps[1], slice(None, -1)), rows_of(steps[0], slice(1, None)))
        broken &= ~steps[4][:-1]
        steps[4][:-1] |= broken
        steps[5][:-1] |= broken
        self._last = tuple(rows_of(field, slice(-1, None)) for field in steps)
        self._write(tuple(rows_of(field, slice(None, -1)) for field in steps))

    def attach(self) -> int:
        """Ends the last piece, adds the buffers to the model's, and returns the number of pieces."""
        if self._last is not None:
            ended = self._last[4].copy()
            self._last[4][:] = True
            self._last[5][:] |= ~ended
            self._write(self._last)
        self._own.prior = (*self._own.prior, *self._buffers)
        self._own.reward_scale = self._scale
        return self._pieces

    def _write(self, steps: tuple[Any, ...]) -> None:
        n, start = len(steps[2]), 0
        while start < n:
            if not self._buffers or self._buffers[-1].full:
                self._buffers.append(make_replay_buffer(self.model, self.size))
            buffer = self._buffers[-1]
            room = min(n - start, buffer.buffer_size - buffer.pos)
            part = tuple(rows_of(field, slice(start, start + room)) for field in steps)
            if isinstance(buffer, HerReplayBuffer):
                _add_one_by_one(buffer, part)
            else:
                _fill(buffer, part)
            start += room
        self.rows += n
        self._pieces += int(steps[4].sum())


def _fill(buffer: Any, steps: tuple[Any, ...]) -> None:
    """Writes rows for which there is room into a buffer, as its own ``add`` would one by one."""
    obs, next_obs, actions, rewards, dones, truncated = steps
    rows = slice(buffer.pos, buffer.pos + len(actions))
    for store, values in ((buffer.observations, obs), (buffer.next_observations, next_obs)):
        for target, value in (
            [(store[key], values[key]) for key in store] if isinstance(store, dict) else [(store, values)]
        ):
            target[rows, 0] = value.reshape(len(actions), *target.shape[2:])
    buffer.actions[rows, 0] = actions.reshape(len(actions), -1)
    buffer.rewards[rows, 0], buffer.dones[rows, 0] = rewards, dones
    if buffer.handle_timeout_termination:
        buffer.timeouts[rows, 0] = truncated
    buffer.pos += len(actions)
    if buffer.pos == buffer.buffer_size:
        buffer.full, buffer.pos = True, 0


def _add_one_by_one(buffer: Any, steps: tuple[Any, ...]) -> None:
    """The same through the ``add`` of a buffer that keeps account of episodes."""
    add = super(KnowledgeMixin, buffer).add  # without taking in labels once more
    last = buffer.buffer_size - 1
    for row in range(len(steps[2])):
        obs, next_obs, action, reward, done, truncated = (rows_of(field, slice(row, row + 1)) for field in steps)
        ends = done | (buffer.pos == last)  # what would go on in another buffer ends in this one
        add(obs, next_obs, action, reward, ends, [{"TimeLimit.truncated": bool(truncated[0] or not done[0])}])


def _differ(one: Any, other: Any) -> BoolArray:
    """(n,) whether two observations are different."""
    pairs = [(one[key], other[key]) for key in one] if isinstance(one, dict) else [(one, other)]
    found = np.zeros(len(pairs[0][0]), dtype=bool)
    for a, b in pairs:
        found |= np.any(a != b, axis=tuple(range(1, a.ndim)))
    return found
