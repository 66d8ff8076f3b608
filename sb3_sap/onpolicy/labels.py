"""Labels the steps of a rollout, and adds what they are worth to the rewards that are learned from."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap.common.arrays import BoolArray, FloatArray, copy_observation
from sb3_sap.predictor.labelling import set_row, take_in
from sb3_sap.predictor.late import LateLabels


class LabelCallback(BaseCallback):
    """Adds each executed action to K. An on-policy model of this package adds one automatically.

    SB3 calls ``on_step`` after the environment's step and before the transition is stored, with all that a label needs
    among its local variables.
    """

    model: Any  # an OnPolicyPermissibilityMixin

    def __init__(self) -> None:
        super().__init__()
        #: (n_envs,) labels of each step of the rollout; empty if there are none.
        self.labels: list[BoolArray] = []
        #: (row, environment, label) of each action of the rollout whose label became known later than its step.
        self.late_labels: list[tuple[Any, Any, BoolArray]] = []
        #: The late labels of the last step, and what they add to the rewards.
        self.late: tuple[LateLabels, FloatArray] | None = None
        #: What the last step adds to the rewards that are learned from, (n_envs,); ``None``: nothing.
        self.added: FloatArray | None = None

    def _on_rollout_start(self) -> None:
        self.labels, self.late_labels = [], []

    def of_rollout(self, values: FloatArray) -> tuple[BoolArray, FloatArray] | None:
        """The labels of the rollout with the values of their steps.

        :param values: (steps, n_envs)
        :return: two arrays of one shape; ``None``: there are no labels
        """
        if self.late_labels:
            rows, envs, labels = (np.concatenate(column) for column in zip(*self.late_labels, strict=True))
            return labels, values[rows, envs]
        return (np.stack(self.labels), values) if len(self.labels) == len(values) else None

    def _on_step(self) -> bool:
        model, normalize = self.model, self.model.get_vec_normalize_env()
        infos, rewards = self.locals["infos"], self.locals["rewards"]
        if normalize is None:
            obs, new_obs = model._last_obs, self.locals["new_obs"]
        else:
            obs, new_obs = model._last_original_obs, normalize.get_original_obs()
            rewards = normalize.get_original_reward()
            model._last_original_obs = new_obs  # SB3 updates it for off-policy algorithms alone
        next_obs = copy_observation(new_obs)
        for i, info in enumerate(infos):
            # Under VecNormalize `take_in` finds the raw one.
            if "terminal_observation" in info and normalize is None:
                set_row(next_obs, i, info["terminal_observation"])
        actions = self.locals["clipped_actions"]
        if isinstance(model.action_space, spaces.Box):
            actions = model.policy.scale_action(actions)
        labels, added, late = take_in(
            model.labelled, model.action_space, obs, next_obs, actions, rewards, self.locals["dones"], infos
        )
        if labels is not None:
            self.labels.append(labels)
        if added is not None and normalize is not None and normalize.norm_reward:
            added = normalize.normalize_reward(rewards + added) - normalize.normalize_reward(rewards)
        self.added = added
        self.late = None if late is None else (late, self._penalties(late))
        return True

    def _penalties(self, late: LateLabels) -> FloatArray:
        """Notes late labels of this rollout, and returns what they add to its rewards."""
        model, normalize = self.model, self.model.get_vec_normalize_env()
        rows = self.locals["rollout_buffer"].pos - late.ages
        inside = rows >= 0
        self.late_labels.append((rows[inside], late.envs[inside], late.of_all[inside]))
        penalties: FloatArray = model.labelled.shaping.of_labels(late.labels, float(model.labelled.reward_scale))
        return penalties if normalize is None else normalize.normalize_reward(penalties)

    def add_late(self, rollout_buffer: RolloutBuffer) -> None:
        """Changes the rewards of earlier steps of the rollout; those of an earlier rollout have been learned from."""
        if self.late is not None:
            late, penalties = self.late
            late.penalise([rollout_buffer.rewards], rollout_buffer.pos - 1, penalties, ring=False)


@contextmanager
def shaped_rewards(rollout_buffer: RolloutBuffer, labels: LabelCallback) -> Iterator[None]:
    """Within the block, the rollout buffer stores rewards with what the labels add.

    The array that SB3 passes on stays as it is: other callbacks may read it, VecNormalize may hold it, and it may be of
    whole numbers, which cannot take a fraction.
    """
    add = rollout_buffer.add

    def shaped_add(obs: Any, action: Any, reward: Any, *args: Any, **kwargs: Any) -> None:
        add(obs, action, reward if labels.added is None else reward + labels.added, *args, **kwargs)
        labels.add_late(rollout_buffer)

    rollout_buffer.add = shaped_add  # type: ignore[method-assign]
    try:
        yield
    finally:
        del rollout_buffer.add
