"""Lets an off-policy algorithm fit its AP predictor to the discounted probability of an event."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import obs_as_tensor

from sb3_sap.common.arrays import FloatArray, Observations
from sb3_sap.common.errors import is_number
from sb3_sap.common.random import make_rng
from sb3_sap.common.torch_utils import own_generators
from sb3_sap.predictor.importing import Into
from sb3_sap.predictor.knowledge import LabelledActions
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.reports import KnowledgeReport, PredictorReport
from sb3_sap.predictor.risk import RiskKnowledge, RiskTarget, steps_at_risk
from sb3_sap.predictor.transfer import PriorKnowledgeMixin


class LearnedRiskMixin(PriorKnowledgeMixin):
    """Adds to an ``event`` the choice of a risk that is learned by bootstrapping, in place of a fixed ``horizon``.

    The further parameters are those of :class:`~sb3_sap.predictor.transfer.PriorKnowledgeMixin`.

    :param risk_discount: γ_risk, from 0 to below 1: E is fitted to Q_risk(s, a) = c + (1 - c) γ_risk Q_risk(s', a'),
        with c = 1 where the ``event`` happened and a' the action of the current policy, without guidance; E is one
        minus it. Labels, which penalties and the accuracy of E follow, are those of the ``horizon`` within which
        γ_risk^k reaches ``risk_threshold``. ``None``: E is fitted to labels
    :param risk_threshold: ε, between 0 and 1: an action is permissible where its risk is below it
    """

    #: The copy of E that later risks are taken from, saved with the model; None without ``risk_discount``.
    risk_target: RiskTarget | None = None

    def __init__(self, *args: Any, risk_discount: float | None = None, risk_threshold: float = 0.3, **kwargs: Any):
        self.risk_discount = risk_discount
        self.risk_threshold = risk_threshold
        super().__init__(*args, **kwargs)

    def _check_knowledge_settings(self) -> None:
        super()._check_knowledge_settings()
        if self.risk_discount is None:
            return
        if not (is_number(self.risk_discount) and 0 <= self.risk_discount < 1):
            raise ValueError(f"`risk_discount` must be a number from 0 to below 1, but is {self.risk_discount!r}.")
        if not (is_number(self.risk_threshold) and 0 < self.risk_threshold < 1):
            raise ValueError(f"`risk_threshold` must lie between 0 and 1, but is {self.risk_threshold!r}.")
        if self.event is None:
            raise ValueError(
                f"`risk_discount` = {self.risk_discount} needs an `event`, whose discounted probability the risk is: "
                "give one, or leave `risk_discount` out."
            )
        if self.horizon != 1:
            raise ValueError(
                f"`horizon` = {self.horizon} and `risk_discount` = {self.risk_discount} were both given, but an action "
                "is judged by one of them: leave one out."
            )

    @property
    def label_horizon(self) -> int:
        if self.risk_discount is None:
            return super().label_horizon
        return steps_at_risk(self.risk_discount, self.risk_threshold)

    def _setup_model(self) -> None:
        super()._setup_model()
        self._new_risk_target()

    def _new_risk_target(self) -> None:
        self.risk_target = None
        if self.risk_discount is not None:
            self.risk_target = RiskTarget(self.predictor, self.risk_discount)
            self._risk_seed = int(make_rng(self.seed, "risk").integers(2**31))

    def set_predictor(self, predictor: Any) -> None:
        super().set_predictor(predictor)
        self._new_risk_target()

    def forget_knowledge(self) -> None:
        super().forget_knowledge()
        self._new_risk_target()

    def draw_examples(self) -> tuple[LabelledActions, FloatArray | None]:
        """What E is fitted to next, and the weight of each example; ``None``: all weigh the same."""
        if self.risk_target is None:
            return super().draw_examples()
        assert isinstance(self.knowledge, RiskKnowledge)
        steps = self.knowledge.sample_steps(self.dataset_size, self.get_vec_normalize_env())
        # Draws from the policy must not shift the base algorithm's generators.
        with own_generators((self._risk_seed + int(self.predictor.n_updates)) % 2**63, self.device):
            found = self.risk_target.examples(steps, self.proposed_actions, self.device)
        self.logger.record_mean("sap/risk", float(np.average(1 - found.labels, weights=steps.weights)))
        return found, steps.weights

    def after_fit(self) -> None:
        super().after_fit()
        if self.risk_target is not None:
            self.risk_target.follow(self.predictor)

    def proposed_actions(self, obs: Observations) -> th.Tensor:
        """(n, action_dim) scaled actions of the current policy alone, drawn from it if it is stochastic.

        :param obs: (n, *obs_shape), as the policy gets them
        """
        policy: Any = self.policy
        training = policy.training
        policy.set_training_mode(False)  # batch statistics belong to the updates of the policy
        try:
            actions: th.Tensor = policy._predict(obs_as_tensor(obs, self.device), deterministic=False)
        finally:
            policy.set_training_mode(training)
        return actions.reshape(len(actions), -1)

    # ---------------------------------------------------------------- what does not go together

    def add_knowledge(self, source: Any, into: Into | None = None, *args: Any, **kwargs: Any) -> KnowledgeReport:
        if self.risk_discount is not None and into != "replay":
            raise ValueError(
                "With `risk_discount` E learns from the model's own steps alone, because labels from elsewhere do not "
                'say what followed: use `into="replay"`, or `horizon` in place of `risk_discount`.'
            )
        return super().add_knowledge(source, into, *args, **kwargs)

    def fit_predictor(self, *args: Any, **kwargs: Any) -> PredictorReport:
        if self.risk_discount is not None:
            raise ValueError(
                "`fit_predictor` fits E to labels, and with `risk_discount` it is fitted while the agent learns: leave "
                "it out, or use `horizon` in place of `risk_discount`."
            )
        return super().fit_predictor(*args, **kwargs)

    # ---------------------------------------------------------------- saving

    @property
    def risk_network(self) -> PermissibilityPredictor | None:
        """The network of `risk_target`, under a name that SB3 can save it by."""
        return None if self.risk_target is None else self.risk_target.network

    def set_parameters(
        self, load_path_or_dict: Any, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        if not isinstance(load_path_or_dict, dict):
            _, load_path_or_dict, _ = load_from_zip_file(load_path_or_dict, device=device, load_data=False)
        held = "risk_network" in load_path_or_dict
        if exact_match and "predictor" in load_path_or_dict and held != (self.risk_discount is not None):
            # Not a ValueError, for the reason that the method it extends gives.
            raise TypeError(
                f"These parameters were saved {'with' if held else 'without'} `risk_discount`, but this model has "
                f"{self.risk_discount!r}: leave `risk_discount` as it was saved, or build a new {type(self).__name__}."
            )
        super().set_parameters(load_path_or_dict, exact_match, device)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, *(["risk_network"] if self.risk_discount is not None else [])], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "risk_target"]
