"""What a model knows before its first step, as batches from which its policy learns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import torch as th
from stable_baselines3.common.utils import obs_as_tensor

from sb3_sap.common.vec_envs import never_updated
from sb3_sap.predictor.familiar import FamiliarityMixin
from sb3_sap.predictor.knowledge import PERMISSIBLE, KnowledgeBuffer
from sb3_sap.predictor.states import random_rows


class KnownExamplesMixin(FamiliarityMixin):
    """Draws states and permissible actions from the transitions of elsewhere, or else from K.

    The parameters are those of :class:`~sb3_sap.predictor.familiar.FamiliarityMixin`.
    """

    def known_states(self, n: int) -> Iterator[Any]:
        """Batches of n observation tensors, without end, of states that E has learned in: those of the log or K, or
        those that came with E where they are more.

        :raise ValueError: if there are none, or E was not fitted
        """
        source = self.knowledge.prior or self.knowledge
        states, own = self.predictor.about.get("states"), sum(source.counts("train"))
        if states and len(next(iter(states.values()))) <= own:
            states = None
        if not (self.predictor.fitted and (states or own)):
            missing = "E is not fitted: call `fit_predictor` first" if len(source) else "nothing is known"
            raise ValueError(f"The policy cannot be taught, because {missing}.")
        self._begin_statistics(source)
        normalize = self.get_vec_normalize_env()
        while True:
            if states is None:
                obs = source.sample_own(n, "train", normalize, balanced=False).observations
            else:
                obs = random_rows(states, n, source.rng)
                obs = obs if normalize is None else normalize.normalize_obs(obs)
            yield obs_as_tensor(cast(Any, obs), self.device)

    @property
    def knows_permissible(self) -> bool:
        """Whether the log, or else K, has permissible actions."""
        return (self.knowledge.prior or self.knowledge).counts("train")[PERMISSIBLE] > 0

    def known_actions(self, n: int) -> Iterator[tuple[Any, th.Tensor]]:
        """Batches of n observation tensors and (n, action_dim) scaled permissible actions of the log or K.

        :raise ValueError: if there are none
        """
        source = self.knowledge.prior or self.knowledge
        if not self.knows_permissible:
            raise ValueError("The policy cannot imitate, because no permissible action is known: use `add_knowledge`.")
        self._begin_statistics(source)
        while True:
            obs, actions, _ = source.sample_class(PERMISSIBLE, n, "train", self.get_vec_normalize_env())
            yield obs_as_tensor(cast(Any, obs), self.device), th.as_tensor(actions, device=self.device)

    def _begin_statistics(self, source: KnowledgeBuffer) -> None:
        """Gives a VecNormalize that has seen nothing the statistics of what is known."""
        env = self.get_vec_normalize_env()
        if env is None or not (env.norm_obs and env.training) or not never_updated(env):
            return
        known = source.training_observations()
        for key, moments in (env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}).items():
            moments.update(known[key])
