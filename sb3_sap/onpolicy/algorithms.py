"""SB3's and sb3-contrib's on-policy algorithms, guided by action permissibility."""

from __future__ import annotations

from sb3_contrib import TRPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_sap.onpolicy.mixin import OnPolicyPermissibilityMixin


class PPOAP(OnPolicyPermissibilityMixin, PPO):
    """PPO guided by action permissibility."""


class A2CAP(OnPolicyPermissibilityMixin, A2C):
    """A2C guided by action permissibility."""


class TRPOAP(OnPolicyPermissibilityMixin, TRPO):
    """TRPO guided by action permissibility, without the loss: its step is a line search, which has no place for it."""

    def _check_settings(self) -> None:
        super()._check_settings()
        if self.permissibility_coef != 0:
            raise ValueError(
                f"`permissibility_coef` = {self.permissibility_coef!r} cannot be used by TRPOAP, whose step is a line "
                "search on the policy's own objective: leave it out, or choose PPOAP."
            )


class RecurrentPPOAP(OnPolicyPermissibilityMixin, RecurrentPPO):
    """Recurrent PPO guided by action permissibility. E sees the observation, not the policy's memory."""


#: Every on-policy algorithm by its RL Zoo name.
ON_POLICY_ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {
    "ppo_ap": PPOAP,
    "a2c_ap": A2CAP,
    "trpo_ap": TRPOAP,
    "ppo_lstm_ap": RecurrentPPOAP,
}
