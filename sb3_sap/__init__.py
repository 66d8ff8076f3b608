"""A Stable-Baselines3 extension that learns which actions are permissible while it learns to act."""

from sb3_sap import envs
from sb3_sap.algorithms import (
    DDPG,
    DDPGAP,
    DDPGAPCE2,
    DDPGCE1,
    DDPGCE2,
    DQNAP,
    QRDQNAP,
    SACAP,
    TD3AP,
    TQCAP,
    CrossQAP,
)
from sb3_sap.check.check import check_permissibility
from sb3_sap.check.report import PermissibilityReport
from sb3_sap.common.extractors import GoalGapExtractor, RescaleExtractor, WithoutMaskExtractor
from sb3_sap.guidance.action_filter import GuidedPolicy
from sb3_sap.guidance.constrained import ConstrainedExplorationMixin
from sb3_sap.guidance.mask_wrapper import ActionMaskObservation
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.guidance.wrapper import LearnedPermissibility
from sb3_sap.onpolicy.algorithms import A2CAP, PPOAP, TRPOAP, RecurrentPPOAP
from sb3_sap.onpolicy.mixin import OnPolicyPermissibilityMixin
from sb3_sap.permissibility import ActionPermissibility, does_not_lower
from sb3_sap.predictor.buffers import (
    KnowledgeMixin,
    PermissibilityDictReplayBuffer,
    PermissibilityHerReplayBuffer,
    PermissibilityNStepReplayBuffer,
    PermissibilityReplayBuffer,
)
from sb3_sap.predictor.callbacks import PermissibilityCallback
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.mixin import LearnedPermissibilityMixin
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.presets import preset


def __getattr__(name: str) -> object:
    """``compare``, which is imported only when it is used, because it needs the libraries of an extra."""
    if name != "compare":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sb3_sap.comparison import compare

    return compare


__version__ = "0.1.0"
__all__ = [
    "A2CAP",
    "DDPG",
    "DDPGAP",
    "DDPGAPCE2",
    "DDPGCE1",
    "DDPGCE2",
    "DQNAP",
    "PPOAP",
    "QRDQNAP",
    "SACAP",
    "TD3AP",
    "TQCAP",
    "TRPOAP",
    "ActionMaskObservation",
    "ActionPermissibility",
    "ActionPermissibilityMixin",
    "ConstrainedExplorationMixin",
    "CrossQAP",
    "GoalGapExtractor",
    "GuidedPolicy",
    "KnowledgeBuffer",
    "KnowledgeMixin",
    "LearnedPermissibility",
    "LearnedPermissibilityMixin",
    "OnPolicyPermissibilityMixin",
    "PermissibilityCallback",
    "PermissibilityDictReplayBuffer",
    "PermissibilityHerReplayBuffer",
    "PermissibilityNStepReplayBuffer",
    "PermissibilityPredictor",
    "PermissibilityReplayBuffer",
    "PermissibilityReport",
    "RecurrentPPOAP",
    "RescaleExtractor",
    "WithoutMaskExtractor",
    "check_permissibility",
    "compare",
    "does_not_lower",
    "envs",
    "preset",
]
