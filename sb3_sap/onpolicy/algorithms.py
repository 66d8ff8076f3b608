"""SB3's and sb3-contrib's on-policy algorithms, guided by action permissibility."""

from __future__ import annotations

from sb3_contrib import TRPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_sap.onpolicy.choosing import by_part, too_many
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
        if self.alpha and too_many(self.action_space) and not by_part(True, self.parts, self._permissible_actions):
            raise ValueError(
                f"TRPOAP bounds the divergence of the guided policy, which cannot be computed for {self.action_space}: "
                "give `action_parts` and labels of each, choose PPOAP, or set `alpha=0`."
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
