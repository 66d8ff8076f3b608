"""Labels transitions, fills the knowledge buffer K with them, and says what they add to the rewards."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, FloatArray
from sb3_sap.common.reward_shaping import RewardScale, RewardShaping
from sb3_sap.common.spaces import unscaled
from sb3_sap.common.vec_envs import RAW_LAST, environment_layout
from sb3_sap.permissibility import APFunction, labels_from_infos, query_labels
from sb3_sap.predictor.events import Event
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.late import LateLabels, late_labels
from sb3_sap.predictor.pending import Pending


class Labels(Protocol):
    """What holds K and knows where labels come from: a replay buffer, or a :class:`LabelledTransitions`."""

    knowledge: KnowledgeBuffer
    ap_function: APFunction | None
    #: What makes mistakes of the actions before it, in place of an AP function.
    event: Event | str | None
    #: The actions that wait for their labels; None: each is labelled at its own step.
    pending: Pending | None
    #: The images that the AP function gets channels last (:func:`~sb3_sap.common.vec_envs.channels_last`).
    images: tuple[str, ...]
    #: What is added to the rewards that are learned from; those of the environment, which are logged, stay.
    shaping: RewardShaping
    #: Whether a transition without a label is an error; otherwise it is not added to K.
    needs_labels: bool
    #: Of the environment's own rewards.
    reward_scale: RewardScale


class LabelledTransitions:
    """K of an on-policy algorithm, which has no replay buffer to hold it, and where its labels come from.

    It is saved with the model.

    :param knowledge: K
    """

    event: Event | str | None = None
    pending: Pending | None = None

    def __init__(self, knowledge: KnowledgeBuffer):
        self.knowledge = knowledge
        self.ap_function: APFunction | None = None
        self.images: tuple[str, ...] = ()
        self.shaping = RewardShaping()
        self.needs_labels = True
        self.reward_scale = RewardScale()

    def __getstate__(self) -> dict[str, Any]:
        # The user's functions belong to the model; the file holds only data.
        return {**vars(self), "ap_function": None, "event": None, "shaping": RewardShaping()}


def take_in(
    holder: Labels,
    action_space: spaces.Space[Any],
    obs: Any,
    next_obs: Any,
    action: np.ndarray[Any, Any],
    reward: np.ndarray[Any, Any],
    done: np.ndarray[Any, Any],
    infos: list[dict[str, Any]],
) -> tuple[BoolArray | None, FloatArray | None, LateLabels | None]:
    """Labels n executed actions and adds them to K; with pending ones, earlier actions whose labels are known now.

    :param obs: raw, (n, *obs_shape)
    :param next_obs: raw and true, (n, *obs_shape); the last observation of an episode is overwritten by the exact one,
        if ``infos`` holds it
    :param action: scaled, (n, *action_shape)
    :param reward: of the environment, (n,)
    :param done: (n,) whether the episode ended
    :return: (n,) the labels, of all parts of the action together, and (n,) what is added to the rewards; ``None``:
        there are none, nothing is added. Then the labels of earlier actions, whose penalties are not among what is
        added
    """
    for i, info in enumerate(infos):
        if RAW_LAST in info:
            set_row(next_obs, i, info[RAW_LAST])
    before, after = (environment_layout(o, holder.images) for o in (obs, next_obs))
    done = np.asarray(done, dtype=bool)
    terminal = done & ~np.array([bool(info.get("TimeLimit.truncated")) for info in infos])
    labels: BoolArray | None = None
    parts = holder.knowledge.part_names
    late: LateLabels | None = None
    if holder.pending is not None:
        late = late_labels(holder, holder.pending, action_space, obs, next_obs, action, terminal, done, infos)
    elif holder.ap_function is not None:
        executed = unscaled(action_space, action)
        labels = query_labels(holder.ap_function, "ap_function", before, executed, after, parts=parts)
    elif holder.needs_labels or any("permissible" in info for info in infos):
        labels = labels_from_infos(infos, parts)
    if labels is not None:
        holder.knowledge.add(obs, action.reshape(len(labels), -1), labels)
    holder.reward_scale.update(reward)
    of_all = labels if labels is None or not parts else np.asarray(labels.all(axis=1))
    if not holder.shaping:
        return of_all, None, late
    return of_all, holder.shaping.difference(labels, before, after, terminal, float(holder.reward_scale)), late


def set_row(observations: Any, row: int, obs: Any) -> None:
    """Writes one observation into a batch."""
    if isinstance(observations, dict):
        for key, batch in observations.items():
            batch[row] = obs[key]
    else:
        observations[row] = obs
