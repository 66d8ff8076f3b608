"""The AP predictor as an environment wrapper, for algorithms of any library."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor

from sb3_sap.common.arrays import BoolArray
from sb3_sap.common.errors import check_at_least, is_number
from sb3_sap.common.random import make_rng
from sb3_sap.common.spaces import check_action_space, check_observation_space
from sb3_sap.common.torch_utils import flush_denormals, own_generators
from sb3_sap.guidance.candidates import candidate_actions, choose
from sb3_sap.permissibility import ActionPermissibility, labels_from_infos
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.pairs import query_candidates
from sb3_sap.predictor.schedule import check_growth, due
from sb3_sap.predictor.weights import check_same_spaces, check_statistics


class LearnedPermissibility(ActionPermissibility):
    """Labels each action, learns E from the labels, replaces what E rejects, and penalises: one environment, any agent.

    An action that E rejects is replaced by the nearest candidate that E permits, with probability ``alpha``, once E's
    balanced validation accuracy is 70 % (section 4.3). ``info`` gets ``"permissible"``, the label of what was executed;
    ``"executed_action"``, in the environment's units; and ``"replaced"``.

    Limits: the agent stores the action that it proposed, not the one that was executed, so that it learns what
    proposing leads to; the penalty for a replaced action tells it to propose others. The loss on E and the saving of
    the guided algorithms are not available; :meth:`action_masks` gives E's verdicts to sb3-contrib's ``MaskablePPO``.
    Each environment has an E of its own. During evaluation use the environment without this wrapper, or one with
    ``alpha=0``.

    :param env: one environment, not a vector of them, with a bounded ``Box`` or a ``Discrete`` action space
    :param permissible: f(s, a | s') of one step, or ``None``, as for the base class
    :param penalty: c, subtracted from the reward of an action that was non-permissible or replaced; ``"auto"``: the
        root mean square of the rewards so far
    :param alpha: α, the probability of asking E; 0: only label, learn and penalise
    :param n_candidates: number of candidates
    :param refit_growth: refit E when the number of steps has grown by this fraction
    :param dataset_size: examples drawn for each fit
    :param knowledge_buffer_size: capacity of K
    :param min_per_class: examples of each class that K must hold before E is fitted
    :param predictor_kwargs: arguments of :class:`~sb3_sap.predictor.network.PermissibilityPredictor`
    :param seed: of all random draws
    :param predictor: an AP predictor of the same spaces to begin with, which was fitted to raw observations, or its
        file; it goes on learning
    :raise ValueError: for a setting or a space that cannot be used
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        permissible: Callable[[Any, Any, Any], bool] | None = None,
        penalty: float | str = "auto",
        alpha: float = 0.9,
        n_candidates: int = 32,
        refit_growth: float = 0.005,
        dataset_size: int = 256,
        knowledge_buffer_size: int = 10_000,
        min_per_class: int = 20,
        predictor_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        predictor: PermissibilityPredictor | str | Path | None = None,
    ):
        super().__init__(env, permissible, penalty)
        if not (is_number(alpha) and 0 <= alpha <= 1):
            raise ValueError(f"`alpha` is a probability from 0 to 1, but is {alpha!r}.")
        self.alpha, self.n_candidates, self.refit_growth = alpha, n_candidates, refit_growth
        self.dataset_size, self.min_per_class = dataset_size, min_per_class
        check_growth(self, "refit_growth")
        check_at_least(self, n_candidates=1, dataset_size=2, min_per_class=1)
        check_action_space(type(self).__name__, self.action_space, discrete=None)
        check_observation_space(type(self).__name__, self.observation_space)
        self._refuse_parts((predictor_kwargs or {}).get("action_parts"))
        self._discrete = isinstance(self.action_space, spaces.Discrete)
        dim = int(np.prod(self.action_space.shape or (1,)))
        self.knowledge = KnowledgeBuffer(self.observation_space, dim, knowledge_buffer_size, seed=seed)
        self._rng = make_rng(seed, "exploration")
        with own_generators(int(make_rng(seed, "predictor").integers(2**31)), th.device("cpu")):
            arguments = {"batch_size": 64, **(predictor_kwargs or {})}
            self.predictor = PermissibilityPredictor(self.observation_space, self.action_space, **arguments)
        #: Balanced accuracy of E on its last validation sample; NaN before the first.
        self.validation_accuracy = float("nan")
        if predictor is not None:
            self._take_over(predictor)
        self._steps = 0

    def _take_over(self, given: PermissibilityPredictor | str | Path) -> None:
        given = PermissibilityPredictor.load(given, "cpu") if isinstance(given, (str, Path)) else copy.deepcopy(given)
        self._refuse_parts(given.parts)
        check_same_spaces(given, self.observation_space, self.action_space)
        check_statistics(given.about.get("statistics"), None)
        self.predictor = given
        self.validation_accuracy = float(given.about.get("accuracy", float("nan")))

    def _refuse_parts(self, parts: Any) -> None:
        if parts:
            raise ValueError(
                f"{type(self).__name__} judges the action as a whole: use an algorithm of sb3_sap for `action_parts`."
            )

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, executed = self._obs, self._permitted(action)
        replaced = executed is not action
        next_obs, reward, terminated, truncated, info = super().step(executed)
        label = labels_from_infos([info])
        if replaced and label[0] and self.shaping:
            reward = float(reward) - self.shaping.penalty_at(float(self.reward_scale))
        self.knowledge.add(_batch(obs), self._scaled(executed), label)
        self._learn()
        return next_obs, reward, terminated, truncated, {**info, "executed_action": executed, "replaced": replaced}

    @th.no_grad()
    @flush_denormals()
    def _permitted(self, action: Any) -> Any:
        """The action itself, or the nearest one that E permits; candidates are the whole space, in strata."""
        if not self.validation_accuracy >= SUFFICIENT_ACCURACY or self._rng.random() >= self.alpha:
            return action
        features = self.predictor.features(obs_as_tensor(_batch(self._obs), th.device("cpu")))
        own = self._scaled(action)
        if query_candidates(self.predictor, features, own[:, None])[0, 0] > 0:
            return action
        ones = np.ones((1, self.knowledge.actions.shape[1]))
        candidates = candidate_actions(self._rng, self.action_space, -ones, ones, self.n_candidates)
        permitted = query_candidates(self.predictor, features, candidates) > 0
        if not permitted.any():
            return action
        distance = np.linalg.norm(candidates - own[:, None], axis=2)
        return self._unscaled(choose(self._rng, candidates, permitted, -distance)[0])

    @th.no_grad()
    @flush_denormals()
    def action_masks(self) -> BoolArray:
        """(n,) which of n discrete actions are permissible now, for sb3-contrib's ``MaskablePPO``.

        They are those that E permits, and that the environment's own ``action_masks()`` allows if it has that method.
        Where E permits none of these, and until its balanced validation accuracy is 70 %, all of these are. With masks
        for the agent choose ``alpha=0``, or E's verdicts are applied twice.
        """
        if not self._discrete:
            raise TypeError(f"A mask lists finitely many actions, but the action space is {self.action_space}.")
        n = int(cast(spaces.Discrete, self.action_space).n)
        allowed = np.ones(n, dtype=bool)
        if self.env.has_wrapper_attr("action_masks"):
            allowed = np.asarray(self.env.get_wrapper_attr("action_masks")(), dtype=bool)
        if not self.validation_accuracy >= SUFFICIENT_ACCURACY:
            return allowed
        features = self.predictor.features(obs_as_tensor(_batch(self._obs), th.device("cpu")))
        every = np.arange(n, dtype=np.float32).reshape(1, n, 1)
        permitted = allowed & (query_candidates(self.predictor, features, every)[0] > 0)
        return permitted if permitted.any() else allowed

    def _learn(self) -> None:
        self._steps += 1
        fits = due(self.refit_growth, self._steps - 1, self._steps)
        if fits and min(self.knowledge.counts("train")) >= self.min_per_class:
            self.predictor.fit(self.knowledge.sample(self.dataset_size))
            if min(self.knowledge.counts("validation")) > 0:
                self.validation_accuracy = sum(self.predictor.recall(self.knowledge.sample(200, "validation"))) / 2

    def _scaled(self, action: Any) -> np.ndarray[Any, Any]:
        """(1, action_dim), from -1 to 1; a discrete action as it is."""
        flat = np.asarray(action, dtype=np.float32).reshape(1, -1)
        if self._discrete:
            return flat
        space = cast(spaces.Box, self.action_space)
        low, high = space.low.reshape(1, -1), space.high.reshape(1, -1)
        return np.asarray(2 * (flat - low) / (high - low) - 1, dtype=np.float32)

    def _unscaled(self, action: np.ndarray[Any, Any]) -> Any:
        if self._discrete:
            return int(action[0])
        space = cast(spaces.Box, self.action_space)
        unit = (action.reshape(space.shape) + 1) / 2
        return (space.low + unit * (space.high - space.low)).astype(space.dtype)


def _batch(obs: Any) -> Any:
    """A batch of one observation."""
    return (
        {key: np.asarray(value)[None] for key, value in obs.items()} if isinstance(obs, dict) else np.asarray(obs)[None]
    )
