"""Replay buffers R that also fill the knowledge buffer K."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.common.arrays import FloatArray
from sb3_sap.common.reward_shaping import RewardScale, RewardShaping
from sb3_sap.common.spaces import unscaled
from sb3_sap.common.vec_envs import environment_layout
from sb3_sap.permissibility import APFunction, query_labels
from sb3_sap.predictor.events import Event
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.labelling import take_in
from sb3_sap.predictor.pending import Pending
from sb3_sap.predictor.risk import RiskKnowledge


class KnowledgeMixin(ReplayBuffer):
    """Makes any SB3 replay buffer R fill K as well; K is saved and loaded with it.

    :param knowledge: K, to which every labelled transition is added
    :param ap_function: labels the transitions; without it the label is taken from ``info["permissible"]``
    """

    #: What makes mistakes of the actions before it, in place of an AP function.
    event: Event | str | None = None
    #: The actions that wait for their labels, saved with the buffer; None: each is labelled at its own step.
    pending: Pending | None = None
    #: The images that the AP function gets channels last (:func:`~sb3_sap.common.vec_envs.channels_last`).
    images: tuple[str, ...] = ()
    #: What is added to the rewards that R stores; those of the environment, which are logged, remain as they are.
    shaping: RewardShaping
    #: Whether a transition without a label is an error; otherwise it is not added to K.
    needs_labels: bool = True
    #: (buffer_size, n_envs) what the stored rewards hold beside the environment's own; None: nothing.
    added: FloatArray | None = None
    #: Transitions from elsewhere, in buffers of this kind.
    prior: tuple[KnowledgeMixin, ...] = ()
    #: The share of a batch that comes from `prior`.
    prior_share: float = 0.5

    def __init__(
        self, *args: Any, knowledge: KnowledgeBuffer | None = None, ap_function: APFunction | None = None, **kwargs: Any
    ):
        if knowledge is None:
            raise TypeError(
                f"A {type(self).__name__} needs `knowledge=KnowledgeBuffer(...)`, which a guided algorithm gives it: "
                "if this came from loading a model, load it with the class that saved it, such as `DDPGAP.load`."
            )
        super().__init__(*args, **kwargs)
        self.knowledge = knowledge
        self.ap_function = ap_function
        self.shaping = RewardShaping()
        #: Of the environment's own rewards, saved with the buffer.
        self.reward_scale = RewardScale()

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray[Any, Any],
        reward: np.ndarray[Any, Any],
        done: np.ndarray[Any, Any],
        infos: list[dict[str, Any]],
    ) -> None:
        # SB3 passes raw observations here, and the true last one of an episode.
        _, added, late = take_in(self, self.action_space, obs, next_obs, action, reward, done, infos)
        if added is not None:
            reward = reward + added
            if self.added is None:
                self.added = np.zeros_like(self.rewards)
        if self.added is not None:
            self.added[self.pos] = 0.0 if added is None else added
        super().add(obs, next_obs, action, reward, done, infos)
        if late is not None and self.shaping.penalises:
            penalties = self.shaping.of_labels(late.labels, float(self.reward_scale))
            late.penalise([self.rewards, cast(FloatArray, self.added)], self.pos - 1, penalties, ring=True)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """SB3's ``sample``; of the batch, ``prior_share`` comes from `prior`, if it holds anything."""
        if not self.prior:
            return super().sample(batch_size, env)
        older = round(batch_size * self.prior_share) if self._has_samples() else batch_size
        sizes = np.array([buffer.size() for buffer in self.prior])
        # From SB3's generator, as the rows within a buffer.
        chosen = np.bincount(np.random.choice(len(sizes), older, p=sizes / sizes.sum()), minlength=len(sizes))  # noqa: NPY002
        parts = [buffer.sample(int(n), env) for n, buffer in zip(chosen, self.prior, strict=True) if n > 0]
        if older < batch_size:
            parts.append(super().sample(batch_size - older, env))
        return _joined(parts)

    def _has_samples(self) -> bool:
        return self.size() > 0

    def __getstate__(self) -> dict[str, Any]:
        # The user's functions belong to the model; the file holds only data.
        return {**super().__getstate__(), "ap_function": None, "event": None, "shaping": RewardShaping()}  # type: ignore[dict-item]


class PermissibilityReplayBuffer(KnowledgeMixin, ReplayBuffer):
    """SB3's replay buffer, which also fills K."""


class PermissibilityDictReplayBuffer(KnowledgeMixin, DictReplayBuffer):
    """The same for ``Dict`` observations."""


class PermissibilityNStepReplayBuffer(KnowledgeMixin, NStepReplayBuffer):
    """The same with n-step returns."""


class PermissibilityHerReplayBuffer(KnowledgeMixin, HerReplayBuffer):
    """The same with hindsight goals; K keeps the goals that were pursued.

    A hindsight goal is labelled, penalised and shaped as if it had been pursued.
    """

    def _has_samples(self) -> bool:
        return bool((self.ep_length > 0).any())

    def _get_virtual_samples(
        self, batch_indices: np.ndarray[Any, Any], env_indices: np.ndarray[Any, Any], env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        if not self.shaping:
            return super()._get_virtual_samples(batch_indices, env_indices, env)
        raw = super()._get_virtual_samples(batch_indices, env_indices, None)
        obs, next_obs = (
            {key: value.cpu().numpy() for key, value in side.items()}
            for side in (raw.observations, raw.next_observations)
        )
        before, after = (environment_layout(side, self.images) for side in (obs, next_obs))
        labels = None
        if self.ap_function is not None and self.pending is None:
            actions = unscaled(self.action_space, raw.actions.cpu().numpy())
            parts = self.knowledge.part_names
            labels = query_labels(self.ap_function, "ap_function", before, actions, after, parts=parts)
        terminal = raw.dones.cpu().numpy().ravel() > 0
        added = self.shaping.difference(labels, before, after, terminal, float(self.reward_scale)).reshape(-1, 1)
        rewards = self._normalize_reward((raw.rewards.cpu().numpy() + added).astype(np.float32), env)
        return raw._replace(
            observations={key: self.to_torch(value) for key, value in _normalized(self, obs, env).items()},
            next_observations={key: self.to_torch(value) for key, value in _normalized(self, next_obs, env).items()},
            rewards=self.to_torch(rewards),
        )


#: For each of SB3's replay buffers, the version that also fills K.
GUIDED_BUFFERS: dict[type[ReplayBuffer], type[KnowledgeMixin]] = {
    ReplayBuffer: PermissibilityReplayBuffer,
    DictReplayBuffer: PermissibilityDictReplayBuffer,
    NStepReplayBuffer: PermissibilityNStepReplayBuffer,
    HerReplayBuffer: PermissibilityHerReplayBuffer,
}


def _joined(parts: list[Any]) -> Any:
    """Several batches of a replay buffer in one."""

    def join(values: Any) -> Any:
        if isinstance(values[0], dict):
            return {key: th.cat([value[key] for value in values]) for key in values[0]}
        return None if values[0] is None else th.cat(values)

    return type(parts[0])(*map(join, zip(*parts, strict=True)))


def _normalized(buffer: ReplayBuffer, obs: dict[str, Any], env: VecNormalize | None) -> dict[str, Any]:
    normalized: Any = buffer._normalize_obs(obs, env)
    return dict(normalized)


def guided_buffer_class(
    requested: type[ReplayBuffer] | None, observation_space: spaces.Space[Any], n_steps: int
) -> type[KnowledgeMixin]:
    """The requested buffer class, or the one that SB3 would have chosen, in the version that fills K.

    :raise ValueError: if the requested class does not fill K, or does not take ``n_steps``
    """
    # A saved model holds the class chosen for its own `n_steps`, and `load` may be given another `n_steps`.
    if requested is None or requested is PermissibilityReplayBuffer:
        plain = NStepReplayBuffer if n_steps > 1 else ReplayBuffer
        requested = DictReplayBuffer if isinstance(observation_space, spaces.Dict) else plain
    guided = GUIDED_BUFFERS.get(requested, requested)
    if not issubclass(guided, KnowledgeMixin):
        known = ", ".join(cls.__name__ for cls in GUIDED_BUFFERS)
        raise ValueError(
            f"`replay_buffer_class` = {requested.__name__} does not feed the knowledge buffer: use one of {known}, "
            f"or derive your own as `class Mine(KnowledgeMixin, {requested.__name__})`."
        )
    if n_steps > 1 and not issubclass(guided, NStepReplayBuffer):
        raise ValueError(
            f"`n_steps` = {n_steps} cannot be combined with {requested.__name__}, which knows one-step returns alone: "
            "use `n_steps=1`, or array observations and no `replay_buffer_class`."
        )
    return guided


def check_fits(loaded: ReplayBuffer, model: Any) -> None:
    """Checks that a model can go on with a loaded replay buffer.

    :raise TypeError: if it holds no K
    :raise ValueError: if it comes from another environment, or from another number of them
    """
    if not isinstance(loaded, KnowledgeMixin):
        raise TypeError(
            f"The file holds a plain {type(loaded).__name__} without a knowledge buffer: "
            f"load one saved by {type(model).__name__}."
        )
    if loaded.n_envs != model.n_envs:
        raise ValueError(
            f"The file holds a replay buffer of {loaded.n_envs} environments, but this model has {model.n_envs}: "
            "load the model with as many environments, or go on with an empty buffer."
        )
    own = model.replay_buffer
    for name in ("n_steps", "gamma"):
        if getattr(loaded, name, None) != getattr(own, name, None):
            raise ValueError(
                f"The file holds a replay buffer with {name} = {getattr(loaded, name, None)}, but this model's has "
                f"{getattr(own, name, None)}: load the model with the `n_steps` and `gamma` of the buffer."
            )
    if isinstance(loaded, HerReplayBuffer) != isinstance(own, HerReplayBuffer):
        raise ValueError(
            f"The file holds a {type(loaded).__name__}, but this model uses a {type(own).__name__}: load the model "
            "with the `replay_buffer_class` of the buffer."
        )
    if loaded.knowledge.part_names != own.knowledge.part_names:
        raise ValueError(
            f"The file holds labels of the parts {loaded.knowledge.part_names}, but this model has "
            f"{own.knowledge.part_names}: build the model with the `action_parts` of the buffer."
        )
    if type(loaded.knowledge) is not type(own.knowledge):
        has = {True: "has", False: "has not"}[isinstance(loaded.knowledge, RiskKnowledge)]
        raise ValueError(
            f"The file's knowledge buffer {has} what followed each action, which `risk_discount` needs: load the model "
            "with the `risk_discount` that the buffer was filled with."
        )
    for name in ("observation_space", "action_space"):
        if getattr(loaded, name) != getattr(model, name):
            raise ValueError(
                f"The file holds a replay buffer whose {name} is {getattr(loaded, name)}, but this model's is "
                f"{getattr(model, name)}: load one that was saved in the same environment."
            )
