"""A loss towards permissible actions inside the base algorithm's own gradient steps (not in the paper)."""

from __future__ import annotations

from numbers import Real
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_sap.common.settings import SettingsMixin
from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.auxiliary_loss import mean_action, preference_loss, rejection
from sb3_sap.guidance.taught_policy import TaughtPolicyMixin
from sb3_sap.guidance.values import q_values

#: The spread of Q is measured where the number of updates is a multiple of this.
MEASURED_EVERY = 10
#: Random actions for each state, over which the spread is measured.
MEASURED_ACTIONS = 8
#: Weight of the earlier measurements in their running mean.
MEMORY = 0.9


class PermissibilityLossMixin(TaughtPolicyMixin):
    """Adds the gradient of a loss on E to each update of the actor, or for discrete actions of the Q-values.

    The actor climbs Q(s, μ(s)) − β σ_Q softplus(−E(s, μ(s))): beside the long-term value, which the critics learn by
    bootstrapping, it gets the immediate judgement, which E learns by supervision alone. σ_Q is the standard deviation
    of Q over random actions in a state, averaged over states, so that one β suits rewards of every scale. The sum is
    one step of the base's own optimizer.

    For discrete actions the loss is that of :func:`~sb3_sap.guidance.auxiliary_loss.preference_loss`, times β.

    :param permissibility_coef: β, a number, a schedule, or ``"lin_1.0"``, which fades to 0 at the end of ``learn``:
        a label that a good policy sometimes violates would bias the end; 0 is the paper's method. The loss is applied
        while E is accurate enough for ``alpha``
    """

    schedules = (*SettingsMixin.schedules, "actor_permissibility_coef", "permissibility_coef")

    def __init__(self, *args: Any, permissibility_coef: float | Schedule | str = 0.0, **kwargs: Any):
        self.permissibility_coef: Any = permissibility_coef
        #: σ_Q, 0 before the first measurement.
        self.q_spread = 0.0
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        coef = self.permissibility_coef
        if isinstance(coef, Real) and not float(coef) >= 0:
            raise ValueError(f"`permissibility_coef` must be at least 0, but is {coef!r}.")
        super()._setup_model()

    @property
    def _current_coef(self) -> float:
        return FloatSchedule(self.permissibility_coef)(self._current_progress_remaining)

    @property
    def predictor_idle(self) -> bool:
        if self._current_coef > 0:
            return False
        # A schedule that has fallen to 0 leaves E without use where α is 0 as well.
        faded = self.permissibility_coef != 0 and self.alpha == 0 and self.actor_permissibility_coef == 0
        return faded or super().predictor_idle

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self._current_coef == 0 or not self.predictor_accurate:
            super().train(gradient_steps, batch_size)
            return
        # Only during this call, so that copies and files of the model hold no hook.
        optimizer = cast(Any, self.policy if self.discrete else self.actor).optimizer
        hook = optimizer.register_step_pre_hook(self._add_gradient)
        try:
            super().train(gradient_steps, batch_size)
        finally:
            hook.remove()

    @flush_denormals()
    def _add_gradient(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        """Adds the gradient of the loss to the base's own, before its optimizer steps."""
        buffer = cast(ReplayBuffer, self.replay_buffer)
        # As many states as one gradient step of E.
        observations = buffer.sample(self.predictor.batch_size, env=self._vec_normalize_env).observations
        modes = {module: module.training for module in self.policy.modules()}  # some evaluate while others train
        if self.discrete:
            loss = self._current_coef * preference_loss(self, self.predictor, observations)
        else:
            if self._n_updates % MEASURED_EVERY == 0 or self.q_spread == 0:
                self._measure_spread(observations)
            own = rejection(self.predictor, observations, mean_action(self.actor, observations))
            loss = self._current_coef * self.q_spread * own
        for module, training in modes.items():
            module.training = training
        trained = [p for group in optimizer.param_groups for p in group["params"] if p.requires_grad]
        if trained and loss.requires_grad:
            loss.backward(inputs=trained)  # type: ignore[no-untyped-call]
        self.logger.record_mean("sap/permissibility_loss", loss.item())

    @th.no_grad()
    def _measure_spread(self, observations: Any) -> None:
        shape = (MEASURED_ACTIONS, self.predictor.batch_size, int(np.prod(cast(Any, self.action_space.shape))))
        actions = self.exploration_rng.uniform(-1, 1, shape).astype(np.float32)
        values = th.stack([q_values(self, observations, a) for a in th.as_tensor(actions, device=self.device)])
        spread = values.std(dim=0).mean().item()
        self.q_spread = MEMORY * self.q_spread + (1 - MEMORY) * spread if self.q_spread else spread
