"""The predictor as an action filter at run time: what the policy proposes is checked before it is executed."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.algorithm1 import GuidedExplorationMixin
from sb3_sap.guidance.candidates import candidate_actions, choose, only_in
from sb3_sap.guidance.masks import check_statistics
from sb3_sap.predictor.pairs import query_candidates


class GuidedPolicy:
    """Predicts as a guided model with ``guided=True``, for tools that take a model, such as ``evaluate_policy``.

    :param model: any guided algorithm
    """

    def __init__(self, model: Any):
        if not hasattr(model, "predictor"):
            raise TypeError(f"`model` must be a guided model, such as a TQCAP, but is a {type(model).__name__}.")
        self.model = model

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray[Any, Any], Any]:
        """The model's ``predict`` with ``guided=True``."""
        actions, state = self.model.predict(observation, state, episode_start, deterministic, guided=True)
        return actions, state


@th.no_grad()
@flush_denormals()
def guided_prediction(
    model: GuidedExplorationMixin, observation: Any, actions: np.ndarray[Any, Any]
) -> np.ndarray[Any, Any]:
    """Replaces each action that is not permissible by the nearest permissible candidate, if there is any.

    The same observation always gives the same action: the candidates are drawn with a seed of their own. ``alpha`` and
    ``constraint``, which needs the previous action, are ignored; E is queried only if it was fitted.

    :param observation: one, or a batch, as ``predict`` takes it
    :param actions: what the policy proposes, in the environment's units
    """
    obs, _ = model.policy.obs_to_tensor(observation)
    shape = cast(Any, model.action_space).shape
    check_statistics(model, model._permissible_actions)
    raw = model.raw_observations(observation)
    proposed = np.asarray(actions).reshape(-1, *shape)
    if not model.discrete:
        proposed = model.policy.scale_action(proposed)
    flat = proposed.reshape(len(proposed), -1)
    # What is known before the step is about the whole action, which comes last.
    whole: tuple[int | None, ...] = (None,) if not model.parts or model._permissible_actions is not None else ()
    for part in (*(model.predictor.judged_parts if model.parts else ()), *whole):
        flat = _repaired(model, obs, raw, flat, part)
    changed = (flat != proposed.reshape(flat.shape)).any(axis=1)
    if not changed.any():
        return actions
    guided = np.array(actions).reshape(proposed.shape)
    guided[changed] = model.unscale_actions(flat.reshape(proposed.shape))[changed]
    return guided.reshape(np.shape(actions))


def _repaired(
    model: GuidedExplorationMixin, obs: Any, raw: Any, flat: np.ndarray[Any, Any], part: int | None
) -> np.ndarray[Any, Any]:
    """(n, action_dim) scaled actions, of which a rejected part, or with None the whole, is replaced."""
    ones = np.ones_like(flat[:1])
    candidates = candidate_actions(np.random.default_rng(0), model.action_space, -ones, ones, model.n_candidates)
    candidates = candidates.repeat(len(flat), axis=0)  # the same for every state of a batch
    if part is not None:
        candidates = only_in(flat, model.parts.indices[part], candidates)
    # The proposal itself comes first and is its own nearest candidate.
    candidates = np.concatenate([flat[:, None], candidates.astype(flat.dtype)], axis=1)
    permissible = model.allowed_candidates(raw, candidates)
    if model.predictor.fitted:
        permissible &= query_candidates(model.predictor, model.predictor.features(obs), candidates, part) > 0
    found = permissible.any(axis=1)
    if not found.any():
        return flat
    distance = np.linalg.norm(candidates - flat[:, None], axis=2)
    flat = flat.copy()
    flat[found] = choose(model.exploration_rng, candidates[found], permissible[found], -distance[found])
    return flat
