"""An AP predictor that has learned elsewhere: whether what is observed here fits it."""

from __future__ import annotations

import warnings
from typing import Any

import torch as th

from sb3_sap.predictor.building import make_predictor
from sb3_sap.predictor.learned import LearnedPredictorMixin
from sb3_sap.predictor.measuring import Familiarity


class FamiliarityMixin(LearnedPredictorMixin):
    """Tests an E of elsewhere on the labels of this environment, and forgets one that does not fit.

    The further parameters are those of :class:`~sb3_sap.predictor.learned.LearnedPredictorMixin`.

    :param freeze_predictor: whether E is never fitted while the agent learns
    """

    def __init__(self, *args: Any, freeze_predictor: bool = False, **kwargs: Any):
        self.freeze_predictor = freeze_predictor
        #: Of an E that has learned elsewhere with what is observed here; None: it has not, or was found to fit or not.
        self.familiarity: Familiarity | None = None
        super().__init__(*args, **kwargs)

    def _expect_familiarity(self) -> None:
        """From now on tests E on new labels before it learns from them."""
        self.familiarity = Familiarity()
        self.knowledge.newest = []

    @th.no_grad()
    def test_familiarity(self) -> None:
        """Tests an E of elsewhere on the newest labels; one that does not fit is forgotten, with what it came from."""
        newest, self.knowledge.newest = self.knowledge.newest, []
        if self.familiarity is None or not newest:  # the K of a loaded model has not collected any yet
            return
        normalize = self.get_vec_normalize_env()
        # One that does not even predict what it came from proves nothing.
        if self.predictor.fitted and self.predictor_accurate:
            for raw, actions, labels in newest:
                obs, _ = self.policy.obs_to_tensor(raw if normalize is None else normalize.normalize_obs(raw))
                logits = self.predictor(obs, th.as_tensor(actions, device=self.device))
                self.familiarity.add((logits > 0).cpu().numpy(), labels)
            self.logger.record("sap/familiarity", self.familiarity.score)
        if self.familiarity.stale and self.freeze_predictor:
            warnings.warn(
                f"The AP predictor is frozen, but contradicts what is observed: its verdicts are right in "
                f"{self.familiarity.score:.0%} of the cases. Let it learn, `freeze_predictor=False`, or leave it out.",
                stacklevel=2,
            )
            self.familiarity = self.knowledge.newest = None
        elif self.familiarity.stale:
            warnings.warn(
                f"What the AP predictor learned elsewhere does not fit what is observed: its verdicts are right in "
                f"{self.familiarity.score:.0%} of the cases. It is forgotten, and learns anew.",
                stacklevel=2,
            )
            self.forget_knowledge()

    def forget_knowledge(self) -> None:
        """Forgets what E learned elsewhere: its weights, and the labelled actions that `add_knowledge` kept for it."""
        self.knowledge.prior, self.knowledge.newest, self.familiarity = None, None, None
        fresh, _ = make_predictor(self, self._predictor_architecture)
        self.predictor.load_state_dict(fresh.state_dict())
        self.predictor.optimizer.load_state_dict(fresh.optimizer.state_dict())
        self.validation_accuracy = float("nan")
