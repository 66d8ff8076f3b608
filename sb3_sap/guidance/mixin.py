"""What turns an SB3 off-policy algorithm into a guided one."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th

from sb3_sap.guidance.action_filter import guided_prediction
from sb3_sap.guidance.masked_values import masked_outputs, values_network
from sb3_sap.guidance.masks import PermissibleActions, masks_at
from sb3_sap.guidance.permissibility_loss import PermissibilityLossMixin


class ActionPermissibilityMixin(PermissibilityLossMixin):
    """Guides an SB3 off-policy algorithm with a learned AP predictor (Algorithm 1).

    Goes before the algorithm in the bases of a class. Each class of the chain has one task and calls the next::

        ActionPermissibilityMixin    predict(guided=True)
        PermissibilityLossMixin      a loss on E within the updates of the actor or the Q-values
        TaughtPolicyMixin            a policy that is taught before the first step
        AuxiliaryLossMixin           the same with updates of its own
        GuidedExplorationMixin       Algorithm 1
        LearnedPermissibilityMixin   labels, knowledge buffer K, AP predictor E
        LearnedRiskMixin             E as a discounted probability of an event
        PriorKnowledgeMixin          a predictor of elsewhere
        ImportMixin                  transitions of elsewhere
        KnownExamplesMixin           batches of them
        FamiliarityMixin             whether they fit
        LearnedPredictorMixin        settings of K and E, saving of E
        WatchedEnvironmentMixin      raw last observations, warnings about the training environment
        ConstrainedExplorationMixin  constraints and permissible actions
        MaskedValuesMixin            masks of discrete actions
        JumpStartMixin               a guide that acts at first
        SettingsMixin                settings that SB3 lacks
        EnvironmentMixin             spaces, wrappers, layouts
        SavingMixin                  what a file holds
        DDPG, TD3, SAC, TQC, ...     the base algorithm

    ``predict`` is the policy alone unless ``guided=True`` is passed, so that every evaluation tool of SB3 measures
    what was learned; both buffers store the executed action.

    The parameters are those of :class:`~sb3_sap.guidance.algorithm1.GuidedExplorationMixin`,
    :class:`~sb3_sap.guidance.permissibility_loss.PermissibilityLossMixin`,
    :class:`~sb3_sap.guidance.auxiliary_update.AuxiliaryLossMixin`,
    :class:`~sb3_sap.predictor.mixin.LearnedPermissibilityMixin`,
    :class:`~sb3_sap.predictor.risk_mixin.LearnedRiskMixin`,
    :class:`~sb3_sap.predictor.transfer.PriorKnowledgeMixin`,
    :class:`~sb3_sap.predictor.importing.ImportMixin`,
    :class:`~sb3_sap.predictor.familiar.FamiliarityMixin`,
    :class:`~sb3_sap.predictor.learned.LearnedPredictorMixin`,
    :class:`~sb3_sap.guidance.constrained.ConstrainedExplorationMixin`,
    :class:`~sb3_sap.guidance.jump_start.JumpStartMixin` and
    :class:`~sb3_sap.common.settings.SettingsMixin`, beside those of the base algorithm.
    """

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray[Any, Any], ...] | None = None,
        episode_start: np.ndarray[Any, Any] | None = None,
        deterministic: bool = False,
        guided: bool = False,
    ) -> tuple[np.ndarray[Any, Any], tuple[np.ndarray[Any, Any], ...] | None]:
        """SB3's ``predict``.

        :param guided: replace an action that ``permissible_actions`` or E rejects by the nearest that they accept
            (:func:`~sb3_sap.guidance.action_filter.guided_prediction`)
        """
        actions, state = super().predict(observation, state, episode_start, deterministic)
        return (guided_prediction(self, observation, actions) if guided else actions), state

    def proposed_actions(self, obs: Any) -> th.Tensor:
        """(n, action_dim) scaled actions of the current policy in n observations, the best allowed ones where discrete
        actions are masked.
        """
        if not self._masks_values:
            return super().proposed_actions(obs)
        mask = masks_at(self, cast(PermissibleActions, self._permissible_actions), obs)
        with masked_outputs(values_network(self), lambda: mask):
            return super().proposed_actions(obs)
