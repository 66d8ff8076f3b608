"""Which guide a model's actions, labels and masks call for."""

from __future__ import annotations

import math
from typing import Any

from gymnasium import spaces

from sb3_sap.common.action_parts import ActionParts
from sb3_sap.common.spaces import sizes_of
from sb3_sap.guidance.masks import ObservedMask, PermissibleActions
from sb3_sap.onpolicy.conditional import ConditionalGuide
from sb3_sap.onpolicy.draws import DrawingGuide
from sb3_sap.onpolicy.enumerated import EnumeratedGuide
from sb3_sap.onpolicy.factored import FactoredGuide
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.known import KnownMasks
from sb3_sap.predictor.network import PermissibilityPredictor

#: Maximum number of combinations of a ``MultiDiscrete`` or ``MultiBinary`` action, or of a part of one, that are judged
#: one by one.
MOST_COMBINATIONS = 4_096


def make_guide(
    model: Any,
    predictor: PermissibilityPredictor | None,
    known: KnownMasks | None = None,
    predicts: bool = False,
    seed: int = 0,
) -> Guide:
    """A guide for a model.

    :param predictor: E; ``None``: there are known masks alone
    :param known: the known masks of a rollout; ``None``: none yet
    :param predicts: whether ``predict`` is guided, too
    :param seed: of further draws from a continuous policy
    """
    space: spaces.Space[Any] = model.action_space
    if isinstance(space, spaces.Box):
        settings = {"n_candidates": model.n_candidates, "squashed": model.policy.squash_output, "seed": seed}
        return DrawingGuide(predictor, space, KnownMasks([]), model.device, predicts, **settings)
    sizes = sizes_of(space)
    shared = (predictor, space, KnownMasks(sizes) if known is None else known, model.device, predicts)
    if len(sizes) > 1 and by_part(predictor is not None, model.parts, model._permissible_actions):
        return FactoredGuide(*shared, parts=model.parts)
    return (ConditionalGuide if too_many(space) else EnumeratedGuide)(*shared)


def by_part(judges: bool, parts: ActionParts, source: PermissibleActions | None) -> bool:
    """Whether everything that restricts an action of several dimensions speaks of its parts, and not of combinations.

    :param judges: whether E is one of the restrictions
    :param parts: those that E judges separately
    :param source: of the known masks
    """
    known = source is None or (isinstance(source, ObservedMask) and not source.joint)
    return known and (bool(parts) or not judges)


def too_many(space: spaces.Space[Any]) -> bool:
    """Whether a finite action of several dimensions has more combinations than are judged one by one."""
    finite = isinstance(space, (spaces.MultiDiscrete, spaces.MultiBinary))
    return finite and math.prod(sizes_of(space)) > MOST_COMBINATIONS


def check_combinations(space: spaces.Space[Any], parts: ActionParts, source: PermissibleActions | None) -> None:
    """Checks that what would be enumerated can be.

    :raise ValueError: if a part, or the actions that a mask of combinations speaks of, have too many combinations
    """
    if isinstance(space, spaces.Box):
        return
    if too_many(space) and not by_part(False, parts, source):
        raise ValueError(
            f"`permissible_actions` judges combinations, of which there may be at most {MOST_COMBINATIONS:,}, but "
            f"{space} has {math.prod(sizes_of(space)):,}: give a mask of each dimension, as ActionMaskObservation does."
        )
    sizes = sizes_of(space)
    for name, dimensions in zip(parts.names, parts.indices, strict=True):
        combinations = math.prod(sizes[dimension] for dimension in dimensions)
        if len(dimensions) > 1 and combinations > MOST_COMBINATIONS:
            raise ValueError(
                f"`action_parts`[{name!r}] has {combinations:,} combinations, of which there may be at most "
                f"{MOST_COMBINATIONS:,}: divide it into smaller parts."
            )
