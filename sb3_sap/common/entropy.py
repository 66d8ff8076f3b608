"""What entropy is worth to an algorithm that maximises it."""

from __future__ import annotations

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


def entropy_weight(model: BaseAlgorithm) -> float:
    """The entropy coefficient that SAC and its kin begin with, in units of the reward; 0 for any other algorithm.

    They maximise rewards plus entropy. A penalty that is small beside the entropy is not learned from while the
    coefficient is large. Where rewards are normalised the units differ, and it is 0, too.
    """
    normalize = model.get_vec_normalize_env()
    if not isinstance(model, OffPolicyAlgorithm) or (normalize is not None and normalize.norm_reward):
        return 0.0
    coef = getattr(model, "ent_coef", 0.0)
    return float(coef.removeprefix("auto").removeprefix("_") or 1) if isinstance(coef, str) else float(coef)
