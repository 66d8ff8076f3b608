"""Labels that are known some steps after the action."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, FloatArray, stack_observations
from sb3_sap.common.spaces import unscaled
from sb3_sap.common.vec_envs import environment_layout
from sb3_sap.permissibility import query_labels
from sb3_sap.predictor.events import happened
from sb3_sap.predictor.pending import Pending
from sb3_sap.predictor.risk import RiskKnowledge

if TYPE_CHECKING:
    from sb3_sap.predictor.labelling import Labels


class LateLabels(NamedTuple):
    """The labels of m actions, which became known at a step."""

    envs: np.ndarray[Any, np.dtype[np.int64]]  # (m,) the environment of each
    ages: np.ndarray[Any, np.dtype[np.int64]]  # (m,) how many steps ago each was executed; 0: at this step
    labels: BoolArray  # (m,), or (m, k) of k parts of the action

    @property
    def of_all(self) -> BoolArray:
        """(m,) the labels of all parts of the action together."""
        return np.asarray(self.labels.all(axis=1)) if self.labels.ndim > 1 else self.labels

    def penalise(self, rewards: list[FloatArray], position: int, penalties: FloatArray, ring: bool) -> None:
        """Adds what the labels are worth to the rewards that are still stored; others were overwritten.

        :param rewards: arrays of (size, n_envs)
        :param position: row of this step
        :param penalties: (m,) what is added
        :param ring: whether the rows before the first one are the last ones, written earlier
        """
        rows = position - self.ages
        stored = rows > position - len(rewards[0]) if ring else rows >= 0
        for array in rewards:
            array[rows[stored] % len(array), self.envs[stored]] += penalties[stored]


def late_labels(
    holder: Labels,
    pending: Pending,
    action_space: spaces.Space[Any],
    obs: Any,
    next_obs: Any,
    action: np.ndarray[Any, Any],
    terminal: BoolArray,
    done: BoolArray,
    infos: list[dict[str, Any]],
) -> LateLabels | None:
    """Takes in a step of n environments, and adds to K the earlier actions whose labels it decides.

    An AP function labels with a window of observations, an event without.

    :param obs: raw, (n, *obs_shape)
    :param next_obs: raw and true, (n, *obs_shape)
    :param action: scaled, (n, *action_shape)
    :param terminal: (n,) whether the episode terminated
    :param done: (n,) whether it ended
    :return: the labels; ``None``: this step decides none
    """
    pending.extend(obs, action, next_obs)
    event = np.zeros(len(done), dtype=bool)
    if holder.event is not None:
        before, after = (environment_layout(o, holder.images) for o in (obs, next_obs))
        event = happened(holder.event, before, unscaled(action_space, action), after, terminal, infos)
    due = pending.take(done if holder.event is None else event | terminal, done)
    if not due:
        return None
    envs = np.array([one.env for one in due])
    first = stack_observations([one.step.obs for one in due])
    actions = np.stack([one.step.action for one in due])
    labels = ~event[envs]
    if holder.event is None:
        assert holder.ap_function is not None
        windows = stack_observations([stack_observations(one.later) for one in due])
        before, after = (environment_layout(o, holder.images) for o in (first, windows))
        argument = f"ap_function, horizon={pending.horizon}"
        labels = query_labels(
            holder.ap_function,
            argument,
            before,
            unscaled(action_space, actions),
            after,
            parts=holder.knowledge.part_names,
        )
    ages = np.array([one.age for one in due])
    flat = actions.reshape(len(due), -1)
    if isinstance(holder.knowledge, RiskKnowledge):
        followed = stack_observations([one.step.next_obs for one in due])
        newest = ages == 0  # of the others the next step is there, so that nothing happened at their own
        holder.knowledge.add_steps(first, flat, labels, followed, event[envs] & newest, terminal[envs] & newest)
    else:
        holder.knowledge.add(first, flat, labels)
    return LateLabels(envs, ages, labels)
