"""Risk: the discounted probability of an event, learned by bootstrapping instead of over a fixed horizon."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sap.common.arrays import BoolArray, FloatArray, Observations
from sb3_sap.predictor.knowledge import CLASSES, KnowledgeBuffer, LabelledActions
from sb3_sap.predictor.network import PermissibilityPredictor

#: Share of the predictor in its target copy after each fit, which makes a few gradient steps.
TARGET_RATE = 0.1


def steps_at_risk(discount: float, threshold: float) -> int:
    """The number of steps, its own included, within which an event makes a mistake of an action.

    An event k steps later is worth a risk of γ^k: those are the k for which it reaches the threshold.

    :param discount: γ, from 0 to below 1
    :param threshold: ε, between 0 and 1
    """
    return 1 if discount == 0 else math.floor(math.log(threshold) / math.log(discount) + 1e-9) + 1


class Steps(NamedTuple):
    """A sample of K with what followed each action: n rows, half of which were mistakes."""

    observations: Observations  # (n, *obs_shape)
    actions: np.ndarray[Any, Any]  # (n, action_dim), scaled
    next_observations: Observations  # (n, *obs_shape)
    events: BoolArray  # (n,) whether the event happened at this step
    ended: BoolArray  # (n,) whether the episode terminated with it, so that nothing can happen afterwards
    weights: FloatArray  # (n,) how much each counts, so that the sample stands for all steps; their mean is about 1


class RiskKnowledge(KnowledgeBuffer):
    """K that also holds where each action led, which bootstrapping needs; it takes twice the memory.

    The parameters are those of :class:`~sb3_sap.predictor.knowledge.KnowledgeBuffer`.
    """

    def __init__(self, observation_space: spaces.Space[Any], *args: Any, **kwargs: Any):
        super().__init__(observation_space, *args, **kwargs)
        self.next_observations = {key: np.zeros_like(store) for key, store in self.observations.items()}
        self.events, self.ended = np.zeros((2, self.size), dtype=bool)

    def __getstate__(self) -> dict[str, Any]:
        filled = self._filled()
        rows = {key: store[filled] for key, store in self.next_observations.items()}
        flags = {"events": self.events[filled], "ended": self.ended[filled]}
        return {**super().__getstate__(), "next_observations": rows, **flags}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.next_observations = {key: self._whole(rows) for key, rows in self.next_observations.items()}
        self.events, self.ended = self._whole(self.events), self._whole(self.ended)

    def add_steps(
        self,
        obs: Observations,
        actions: np.ndarray[Any, Any],
        labels: BoolArray,
        next_obs: Observations,
        events: BoolArray,
        ended: BoolArray,
    ) -> None:
        """Adds n labelled actions and what followed them.

        :param obs: (n, *obs_shape), raw
        :param actions: (n, action_dim), scaled
        :param labels: (n,) bool
        :param next_obs: (n, *obs_shape), raw and true
        :param events: (n,) whether the event happened at the step itself
        :param ended: (n,) whether the episode terminated with it
        """
        slots = self.add(obs, actions, labels)
        keyed = next_obs if isinstance(next_obs, dict) else {"": next_obs}
        for key, store in self.next_observations.items():
            store[slots] = keyed[key]
        self.events[slots], self.ended[slots] = events, ended

    def sample_steps(self, n: int, env: VecNormalize | None = None) -> Steps:
        """Draws from the training part n // 2 steps of each class, with replacement, in random order.

        :param env: normalises the observations, if given
        """
        drawn, labels = self._draw(n, "train")
        slots = self._offset["train"] + drawn
        both = []
        for stores in (self.observations, self.next_observations):
            rows = {key: store[slots] for key, store in stores.items()}
            obs: Any = rows if self._keyed else rows[""]
            both.append(obs if env is None else env.normalize_obs(obs))
        # Mistakes are drawn more often than they happen, which by itself would make everything look risky.
        shares = np.array([self.seen[label] for label in CLASSES]) / sum(self.seen)
        weights = (len(CLASSES) * shares[labels.astype(int)]).astype(np.float32)
        return Steps(both[0], self.actions[slots], both[1], self.events[slots], self.ended[slots], weights)


class RiskTarget:
    """A copy of the predictor that follows it slowly: what the predictor is fitted to does not move with every fit.

    :param predictor: E
    :param discount: γ
    """

    def __init__(self, predictor: PermissibilityPredictor, discount: float):
        self.network = copy.deepcopy(predictor)
        self.discount = discount

    @th.no_grad()
    def examples(
        self, steps: Steps, proposed: Callable[[Observations], th.Tensor], device: th.device
    ) -> LabelledActions:
        """The steps, labelled with the probability that no event follows: one minus Q_risk(s, a).

        Q_risk(s, a) = c + (1 - c) γ Q_risk(s', a'), with c = 1 where the event happened, and 0 after an episode that
        terminated without one (Thananjeyan et al. 2021, Eq. 1).

        :param proposed: the scaled actions a', (n, action_dim), of a policy in n observations
        """
        next_obs: Any = obs_as_tensor(steps.next_observations, device)
        logits = self.network.raw_logits(self.network.features(next_obs), proposed(steps.next_observations))
        later = self.discount * th.sigmoid(-logits).squeeze(1).cpu().numpy()
        risk = np.where(steps.events, 1.0, np.where(steps.ended, 0.0, later))
        return LabelledActions(steps.observations, steps.actions, (1.0 - risk).astype(np.float32))

    @th.no_grad()
    def follow(self, predictor: PermissibilityPredictor) -> None:
        """Moves the copy a little towards the predictor; buffers, such as running means, are taken over."""
        for weight, other in zip(self.network.parameters(), predictor.parameters(), strict=True):
            weight.lerp_(other, TARGET_RATE)
        for buffer, newer in zip(self.network.buffers(), predictor.buffers(), strict=True):
            buffer.copy_(newer)
