"""A rival from constrained reinforcement learning: SAC with a Lagrangian and a safety critic, used by the benchmark.

Recovery RL (Thananjeyan et al. 2021) learns a risk beside the task: Q_risk(s, a) = E[mistake + γ_risk (1 - mistake)
Q_risk(s', π(s'))], the discounted probability of a mistake. Where the risk of what the policy proposes exceeds ε, a
recovery policy acts, here the least risky of many candidates. The multiplier of the penalty in the reward follows the
share of mistakes (RCPO, Tessler et al. 2019). A mistake is what the AP function labels False, so that all rivals know
the same.
"""

from __future__ import annotations

from collections import deque
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_sap.algorithms import SACAP
from sb3_sap.common.arrays import rows_of
from sb3_sap.common.reward_shaping import RewardShaping
from sb3_sap.common.torch_utils import own_generators
from sb3_sap.permissibility import query_labels
from sb3_sap.predictor.buffers import KnowledgeMixin

#: Updates over which the share of mistakes is measured.
WINDOW = 500


class SACRecovery(SACAP):
    """SAC with the multiplier of RCPO and the safety critic of Recovery RL, for one environment and an AP function.

    :param recovery_threshold: ε, the risk above which the recovery policy acts; 1: never
    :param critic_discount: γ_risk
    :param mistake_bound: the share of mistakes that the multiplier aims at
    :param multiplier_rate: change of the multiplier at each step, for a share of 1 above the bound
    """

    def __init__(
        self,
        *args: Any,
        recovery_threshold: float = 0.7,
        critic_discount: float = 0.5,
        mistake_bound: float = 0.1,
        multiplier_rate: float = 0.01,
        **kwargs: Any,
    ):
        self.recovery_threshold, self.critic_discount = recovery_threshold, critic_discount
        self.mistake_bound, self.multiplier_rate = mistake_bound, multiplier_rate
        self.multiplier = 0.0
        self._mistakes: deque[int] = deque(maxlen=WINDOW)
        super().__init__(*args, **{"alpha": 1.0, **kwargs})

    def _setup_model(self) -> None:
        super()._setup_model()
        inputs = self.predictor.features_extractor.features_dim + int(np.prod(cast(Any, self.action_space.shape)))
        with own_generators(self.seed or 0, self.device):
            self.safety_critic = nn.Sequential(*create_mlp(inputs, 1, [64, 64])).to(self.device)
        self.safety_critic_optimizer = th.optim.Adam(self.safety_critic.parameters(), lr=1e-3)

    def _critic_risk(self, obs: Any, actions: th.Tensor) -> th.Tensor:
        """(n,) logits of the risk; E's extractor only flattens."""
        return cast(th.Tensor, self.safety_critic(th.cat([self.predictor.features(obs), actions], dim=1))).squeeze(1)

    @th.no_grad()
    def guide(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
        """Replaces what is too risky by the least risky candidate."""
        obs, _ = self.policy.obs_to_tensor(cast(Any, self._last_obs))
        everywhere = np.arange(len(actions))
        risk = th.sigmoid(self._critic_risk(obs, th.as_tensor(actions, device=self.device))).cpu().numpy()
        risky = np.flatnonzero(risk > self.recovery_threshold)
        if len(risky) == 0:
            return None
        candidates, _ = self.sample_candidates(everywhere[risky], len(actions))
        m, n, dim = candidates.shape
        repeated = rows_of(obs, np.repeat(risky, n))
        risks = self._critic_risk(repeated, th.as_tensor(candidates.reshape(m * n, dim), device=self.device)).reshape(
            m, n
        )
        recovered = actions.copy()
        recovered[risky] = candidates[np.arange(m), risks.argmin(dim=1).cpu().numpy()]
        return recovered

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        self._mistakes.append(self.knowledge.seen[0])
        share = (self._mistakes[-1] - self._mistakes[0]) / max(1, len(self._mistakes) - 1)
        self.multiplier = max(0.0, self.multiplier + self.multiplier_rate * (share - self.mistake_bound))
        buffer = cast(KnowledgeMixin, self.replay_buffer)
        buffer.shaping = RewardShaping(self.multiplier * float(buffer.reward_scale), None, self.gamma)
        super().train(gradient_steps, batch_size)
        for _ in range(gradient_steps):
            self._update_critic(buffer)

    def _update_critic(self, buffer: KnowledgeMixin) -> None:
        """One step of the safety critic, on a batch whose mistakes the AP function tells."""
        data: Any = buffer.sample(self.batch_size)
        before, after = (_arrays(side) for side in (data.observations, data.next_observations))
        actions = self.unscale_actions(data.actions.cpu().numpy())
        permissible = query_labels(cast(Any, buffer.ap_function), "ap_function", before, actions, after)
        mistake = th.as_tensor(~permissible, dtype=th.float32, device=self.device)
        with th.no_grad():
            proposed, _ = self.actor.action_log_prob(data.next_observations)
            later = th.sigmoid(self._critic_risk(data.next_observations, proposed)) * (1 - data.dones.squeeze(1))
            target = mistake + (1 - mistake) * self.critic_discount * later
        loss = F.binary_cross_entropy_with_logits(self._critic_risk(data.observations, data.actions), target)
        self.safety_critic_optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.safety_critic_optimizer.step()


def _arrays(observations: Any) -> Any:
    """Observations of a batch as NumPy arrays."""
    if isinstance(observations, dict):
        return {key: value.cpu().numpy() for key, value in observations.items()}
    return observations.cpu().numpy()
