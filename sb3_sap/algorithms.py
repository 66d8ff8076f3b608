"""The paper's DDPG-AP and its baselines (section 5.1), and guided versions of other off-policy algorithms."""

from __future__ import annotations

from typing import Any, ClassVar

from sb3_contrib import QRDQN, TQC, CrossQ
from stable_baselines3 import DDPG as PlainDDPG
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_sap.common.errors import nearest
from sb3_sap.guidance.constrained import ConstrainedExplorationMixin
from sb3_sap.guidance.constraints import ActionConstraint
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.predictor.mixin import LearnedPermissibilityMixin

#: Dotted names of the lane-keeping constraints (section 5.1), because the algorithms import no environment.
CE1 = "sb3_sap.envs.constraint_ce1"
CE2 = "sb3_sap.envs.constraint_ce2"


class DDPG(ConstrainedExplorationMixin, PlainDDPG):
    """SB3's DDPG with the settings of :class:`~sb3_sap.common.settings.SettingsMixin` and
    :class:`~sb3_sap.guidance.constrained.ConstrainedExplorationMixin`; if none is set, it is bit-identical to SB3's.
    """


class DDPGAP(ActionPermissibilityMixin, PlainDDPG):
    """DDPG-AP: DDPG guided by action permissibility (Algorithm 1).

    Paper: Mazumder et al., "Action Permissibility in Deep Reinforcement Learning and Application to Autonomous
    Driving", KDD'18 Deep Learning Day.

    The parameters are those of SB3's ``DDPG`` and of
    :class:`~sb3_sap.guidance.mixin.ActionPermissibilityMixin`.
    """


class DDPGCE1(DDPG):
    """DDPG-CE1: left of the centre line never steer further left than a step before, right of it not further right."""

    def __init__(self, *args: Any, constraint: ActionConstraint | str = CE1, **kwargs: Any):
        super().__init__(*args, constraint=constraint, **kwargs)


class DDPGCE2(DDPG):
    """DDPG-CE2: the constraint of DDPG-CE1, applied only while the car moves away from the centre line."""

    def __init__(self, *args: Any, constraint: ActionConstraint | str = CE2, **kwargs: Any):
        super().__init__(*args, constraint=constraint, **kwargs)


class DDPGAPCE2(DDPGAP):
    """DDPG-(AP+CE2): the constraint of DDPG-CE2 bounds the actions and the candidates that E filters."""

    def __init__(self, *args: Any, constraint: ActionConstraint | str = CE2, **kwargs: Any):
        super().__init__(*args, constraint=constraint, **kwargs)


class TD3AP(ActionPermissibilityMixin, TD3):
    """TD3 guided by action permissibility."""


class SACAP(ActionPermissibilityMixin, SAC):
    """SAC guided by action permissibility. Its stochastic policy explores without action noise."""

    explores_without_noise: ClassVar[bool] = True


class TQCAP(ActionPermissibilityMixin, TQC):
    """TQC guided by action permissibility."""

    explores_without_noise: ClassVar[bool] = True


class CrossQAP(ActionPermissibilityMixin, CrossQ):
    """CrossQ guided by action permissibility."""

    explores_without_noise: ClassVar[bool] = True


class DQNAP(ActionPermissibilityMixin, DQN):
    """DQN guided by action permissibility. The candidates A_st are all actions; the ε-greedy action is guided, too."""

    explores_without_noise: ClassVar[bool] = True


class QRDQNAP(ActionPermissibilityMixin, QRDQN):
    """QR-DQN guided by action permissibility."""

    explores_without_noise: ClassVar[bool] = True


#: Every algorithm by its RL Zoo name.
ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {
    "ddpg": DDPG,
    "ddpg_ce1": DDPGCE1,
    "ddpg_ce2": DDPGCE2,
    "ddpg_ap": DDPGAP,
    "ddpg_ap_ce2": DDPGAPCE2,
    "td3_ap": TD3AP,
    "sac_ap": SACAP,
    "tqc_ap": TQCAP,
    "crossq_ap": CrossQAP,
    "dqn_ap": DQNAP,
    "qrdqn_ap": QRDQNAP,
}


#: Every algorithm that learns permissibility, off-policy and on-policy, by its RL Zoo name.
GUIDED_ALGORITHMS: dict[str, type[OffPolicyAlgorithm] | type[OnPolicyAlgorithm]] = {
    **{name: cls for name, cls in ALGORITHMS.items() if issubclass(cls, LearnedPermissibilityMixin)},
    **ON_POLICY_ALGORITHMS,
}


def is_guided(algo: str) -> bool:
    """Whether the algorithm of that RL Zoo name learns permissibility."""
    return algo in GUIDED_ALGORITHMS


def guided_name(algo: str) -> str:
    """The RL Zoo name of the guided algorithm that is meant: its own, or that of its base, such as ``"ppo"``.

    :raise ValueError: if there is none
    """
    for name in (algo, f"{algo}_ap"):
        if name in GUIDED_ALGORITHMS:
            return name
    raise ValueError(f"`algo` = {algo!r} has no guided algorithm: {nearest(algo, list(GUIDED_ALGORITHMS))}")


def base_of(algo: str) -> str:
    """The RL Zoo name of an algorithm's base, such as ``"ddpg"`` of ``"ddpg_ap_ce2"``; for others, their own name."""
    if algo in ON_POLICY_ALGORITHMS:
        return algo.removesuffix("_ap")
    if algo not in ALGORITHMS:
        return algo
    bases = (cls for cls in ALGORITHMS[algo].__mro__ if not cls.__module__.startswith("sb3_sap."))
    return next(bases).__name__.lower()
