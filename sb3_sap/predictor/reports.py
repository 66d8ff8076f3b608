"""What was learned from transitions of elsewhere, in numbers and as a sentence."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY


@dataclass(frozen=True)
class KnowledgeReport:
    """What `add_knowledge` took from a source.

    :param rows: transitions read
    :param permissible: of those taken, how many are labelled permissible
    :param non_permissible: how many are labelled mistakes
    :param unlabelled: taken into the replay buffer alone, without a label
    :param into_replay: taken into the replay buffer
    :param episodes: of those, the number of episodes or of unbroken pieces
    :param refused: how many rows were refused, by reason
    :param without_rewards: whether the replay buffer was left out because there are no rewards
    :param kept_examples: labelled actions that are kept for E, a balanced random sample of all
    """

    rows: int = 0
    permissible: int = 0
    non_permissible: int = 0
    unlabelled: int = 0
    into_replay: int = 0
    episodes: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    kept_examples: int = 0
    without_rewards: bool = False

    def __str__(self) -> str:
        labelled = self.permissible + self.non_permissible
        parts = [f"{self.rows:,} transitions read"]
        if labelled:
            share = self.non_permissible / labelled
            parts.append(f"{labelled:,} labelled, {share:.1%} of them mistakes; {self.kept_examples:,} kept for E")
        if labelled and not self.into_replay and self.without_rewards:
            parts.append("there are no rewards, so that the replay buffer got none")
        if self.into_replay:
            parts.append(f"{self.into_replay:,} in {self.episodes:,} pieces put beside the replay buffer")
        parts += [f"{n:,} refused: {reason}" for reason, n in self.refused.items() if n]
        return "; ".join(parts) + "."


@dataclass(frozen=True)
class PredictorReport:
    """How well E predicts labels that it has not learned from, half of them of each class.

    :param accuracy: balanced accuracy, from 0.5 (chance) to 1
    :param permissible: share of the permissible actions that E permits
    :param non_permissible: share of the mistakes that E rejects
    :param calibration_error: expected calibration error: how far, on average, the predicted probability is from the
        share that is permissible, with ten bins
    :param loss: cross-entropy
    :param examples: labelled actions that it was measured on
    :param epochs: passes over the training examples; 0: E was only measured
    """

    accuracy: float
    permissible: float
    non_permissible: float
    calibration_error: float
    loss: float
    examples: int
    epochs: int = 0

    def __str__(self) -> str:
        doubt = ""
        if self.accuracy < SUFFICIENT_ACCURACY:
            doubt = (
                f" Below {SUFFICIENT_ACCURACY:.0%} it is not trusted: does the label depend on state and action alone, "
                "and are the observations of similar size (RescaleExtractor, VecNormalize)?"
            )
        after = f" after {self.epochs} epochs" if self.epochs else ""
        return (
            f"Balanced accuracy {self.accuracy:.3f}{after}: permits {self.permissible:.1%} of the permissible actions, "
            f"rejects {self.non_permissible:.1%} of the mistakes; calibration error {self.calibration_error:.3f}, "
            f"on {self.examples:,}{' held-out' if self.epochs else ''} actions.{doubt}"
        )
