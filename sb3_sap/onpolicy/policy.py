"""A policy of SB3's or sb3-contrib's whose action distribution a guide may restrict."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.loss import PermissibilityLoss

#: Attributes that copies and files do not hold.
OF_A_PASS = ("guide", "permissibility_loss", "_unguided", "_pass")


class GuidedPolicyMixin(ActorCriticPolicy):
    """Goes before an actor-critic policy. Without a guide, it is that policy to the bit.

    The model sets the guide while it collects a rollout and learns from it, so that copies and files hold none.
    Every forward pass of SB3's policies makes its distribution with ``_get_action_dist_from_latent``, which does not
    get the observations: they are kept for that moment.
    """

    guide: Guide | None = None
    #: Is added to the loss of an update, if the model sets it.
    permissibility_loss: PermissibilityLoss | None = None
    _unguided: Distribution | None = None  # of the pass in progress
    _pass: tuple[Any, th.Tensor | None] | None = None  # (observations, executed actions) of the pass in progress

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        extractor = super().make_features_extractor()
        # For MultiDiscrete observations SB3's is NumPy's, which torch's LSTM refuses.
        extractor._features_dim = int(extractor._features_dim)
        return extractor

    def forward(self, obs: Any, *args: Any, **kwargs: Any) -> Any:
        return self._guided(super().forward, obs, None, (obs, *args), kwargs)

    def evaluate_actions(self, obs: Any, actions: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        if isinstance(self.action_space, spaces.MultiBinary):
            actions = actions.float()  # sb3-contrib's recurrent buffer has bytes, which torch refuses
        result = self._guided(super().evaluate_actions, obs, actions, (obs, actions, *args), kwargs)
        if self.permissibility_loss is None:
            return result
        values, log_prob, entropy = result
        unguided, self._unguided = cast(Distribution, self._unguided), None
        recurrent = hasattr(self, "lstm_actor")
        return values, self.permissibility_loss.added_to(log_prob, obs, unguided, recurrent), entropy

    def get_distribution(self, obs: Any, *args: Any, **kwargs: Any) -> Any:
        return self._guided(super().get_distribution, obs, None, (obs, *args), kwargs)

    def _predict(self, *args: Any, **kwargs: Any) -> Any:
        # An evaluation amid a rollout measures the policy alone.
        guide = self.guide
        if guide is not None and not guide.predicts:
            self.guide = None
        try:
            return super()._predict(*args, **kwargs)
        finally:
            self.guide = guide

    def _guided(
        self, method: Callable[..., Any], obs: Any, executed: th.Tensor | None, args: tuple[Any, ...], kwargs: Any
    ) -> Any:
        if self.guide is None and self.permissibility_loss is None:
            return method(*args, **kwargs)
        self._pass = (obs, executed)
        try:
            result = method(*args, **kwargs)
            if getattr(self, "_pass", None) is not None:  # the method has not made a distribution
                raise TypeError(
                    f"The policy {type(self).__name__} does not make its action distribution with SB3's "
                    "`_get_action_dist_from_latent`, so that it cannot be guided: call that method, or set `alpha=0`."
                )
            return result
        finally:
            self._pass = None

    def _get_action_dist_from_latent(self, *args: Any, **kwargs: Any) -> Distribution:
        distribution = super()._get_action_dist_from_latent(*args, **kwargs)
        if self._pass is None:
            return distribution
        (obs, executed), self._pass = self._pass, None
        if executed is not None:
            self._unguided = distribution
        return distribution if self.guide is None else self.guide.distribution(obs, distribution, executed)

    def __reduce__(self) -> Any:
        # The class cannot be found by its name, and a copy made amid a rollout is the policy alone.
        state = {name: value for name, value in vars(self).items() if name not in OF_A_PASS}
        return _new, (type(self).__mro__[2],), state


@cache
def guided_policy_class(plain: type[ActorCriticPolicy]) -> type[GuidedPolicyMixin]:
    """The guided version of a policy class, under the same name."""
    if issubclass(plain, GuidedPolicyMixin):
        return plain
    names = {"__module__": plain.__module__, "__qualname__": plain.__qualname__, "__doc__": plain.__doc__}
    return type(plain.__name__, (GuidedPolicyMixin, plain), names)


def _new(plain: type[ActorCriticPolicy]) -> GuidedPolicyMixin:
    cls = guided_policy_class(plain)
    return cls.__new__(cls)
