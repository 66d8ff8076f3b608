"""What restricts a policy's distribution to what E and the known masks permit."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.logger import Logger

from sb3_sap.onpolicy.known import KnownMasks
from sb3_sap.predictor.network import PermissibilityPredictor


class Guide:
    """Restricts the policy in a rollout and its update. How it does so depends on the actions and is for subclasses.

    What it finds out in a rollout holds in the update, before which E changes.

    :param predictor: E, which must not change while a rollout is collected; ``None``: known masks alone
    :param space: the action space
    :param known: the known masks of the states
    :param device: of the policy
    :param predicts: whether ``predict`` is guided, too
    """

    def __init__(
        self,
        predictor: PermissibilityPredictor | None,
        space: spaces.Space[Any],
        known: KnownMasks,
        device: th.device,
        predicts: bool = False,
    ):
        self.predictor = predictor
        self.space = space
        self.known = known
        self.device = device
        self.predicts = predicts
        #: Where rates are recorded; ``None``: nowhere.
        self.logger: Logger | None = None

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        """A policy's distribution, guided.

        :param obs: n observation tensors
        :param distribution: of the policy in these states
        :param executed: (n, *action_shape) actions to be evaluated, which this guide has chosen
        """
        raise NotImplementedError

    def losses(self, obs: Any, distribution: Distribution) -> th.Tensor:
        """(n,) how much a policy errs in n states, according to E.

        :param obs: n observation tensors
        :param distribution: of the policy alone in these states
        """
        raise NotImplementedError

    def record(self, name: str, value: th.Tensor) -> None:
        """Records the mean of (n,) rates of a rollout."""
        if self.logger is not None:
            self.logger.record_mean(name, value.float().mean().item())
