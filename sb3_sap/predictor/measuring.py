"""Measures an AP predictor: on examples kept for it, and on new ones before it learns from them."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import obs_as_tensor
from torch.nn import functional as F

from sb3_sap.common.arrays import BoolArray
from sb3_sap.predictor.knowledge import LabelledActions
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.reports import PredictorReport

#: Bins of the calibration error.
BINS = 10
#: Verdicts of each kind that are remembered, and labels after which they are judged.
WINDOW, FIRST = 100, 50
#: Mean share of right verdicts, over those of each kind, below which E contradicts what is observed; chance is 0.5.
#: Near it are also the verdicts of a good E on the actions of a good policy, where a heuristic label is hard to tell.
STALE = 0.45


@th.no_grad()
def measure(predictor: PermissibilityPredictor, sample: LabelledActions, epochs: int = 0) -> PredictorReport:
    """Measures E on a balanced sample that it has not learned from."""
    actions, labels = (th.as_tensor(array, device=predictor.device) for array in sample[1:])
    obs: Any = obs_as_tensor(sample.observations, predictor.device)
    if predictor.parts:
        predictor.recall(sample)  # notes how accurate each part is
    logits = predictor.raw_logits(predictor.features(obs), actions)
    labels = labels.reshape(logits.shape)
    known = ~labels.isnan()
    logits, labels = logits[known], labels[known]
    loss = F.binary_cross_entropy_with_logits(logits, labels).item()
    probability, permissible = th.sigmoid(logits).cpu().numpy(), (labels > 0.5).cpu().numpy()
    right = (logits.cpu().numpy() > predictor.offset) == permissible
    of_permissible, of_mistakes = (float(right[chosen].mean()) for chosen in (permissible, ~permissible))
    bins = np.minimum((probability * BINS).astype(int), BINS - 1)
    error = sum(
        abs(probability[bins == b].mean() - permissible[bins == b].mean()) * (bins == b).mean() for b in np.unique(bins)
    )
    accuracy = (of_permissible + of_mistakes) / 2
    return PredictorReport(accuracy, of_permissible, of_mistakes, float(error), loss, len(permissible), epochs)


class Familiarity:
    """Whether an E that was learned elsewhere fits what is observed here, told by labels that it has not yet seen.

    The recall of each class would not tell: guidance executes few of the actions that E rejects, so that the mistakes
    which remain are those that E does not see, however good it is. But among the executed actions that E permits, or
    rejects, the share that it is right about does not depend on how many of them are executed.
    """

    def __init__(self) -> None:
        self._right: dict[bool, deque[bool]] = {verdict: deque(maxlen=WINDOW) for verdict in (False, True)}

    def add(self, verdicts: BoolArray, labels: BoolArray) -> None:
        """Takes in E's verdicts on n executed actions, and their labels."""
        for verdict, label in zip(verdicts.tolist(), labels.tolist(), strict=True):
            self._right[verdict].append(verdict == label)

    @property
    def score(self) -> float:
        """The mean share of right verdicts over both kinds, as if one more of each were right and one more wrong."""
        shares = [(sum(right) + 1) / (len(right) + 2) for right in self._right.values()]
        return sum(shares) / 2

    @property
    def stale(self) -> bool:
        """Whether enough was seen to tell that E does not fit."""
        return sum(map(len, self._right.values())) >= FIRST and self.score < STALE
