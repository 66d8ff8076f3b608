"""An AP predictor that begins elsewhere: as a file, or fitted before the first step."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_sap.predictor.building import make_predictor
from sb3_sap.predictor.fitting import fit_until_best, with_progress
from sb3_sap.predictor.importing import ImportMixin
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.reports import PredictorReport
from sb3_sap.predictor.states import some_states
from sb3_sap.predictor.weights import check_same_spaces, check_statistics, statistics_of


class PriorKnowledgeMixin(ImportMixin):
    """Lets a model begin with what was learned elsewhere, and learn from the transitions of somebody else.

    The further parameters are those of :class:`~sb3_sap.predictor.importing.ImportMixin`.

    :param predictor: an AP predictor to begin with, or the file that :meth:`save_predictor` wrote. It must be of the
        same spaces, and goes on learning
    """

    def __init__(self, *args: Any, predictor: PermissibilityPredictor | str | Path | None = None, **kwargs: Any):
        self._given_predictor = predictor
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        given, self._given_predictor = self._given_predictor, None
        if given is not None:
            self.set_predictor(given)

    def set_predictor(self, predictor: PermissibilityPredictor | str | Path) -> None:
        """Puts an AP predictor that was fitted elsewhere in the place of the model's own; it goes on learning.

        :param predictor: a predictor, or the file that :meth:`save_predictor` wrote
        :raise ValueError: if it is of other spaces, of another architecture than ``predictor_kwargs`` say, or was
            fitted to observations that were normalised otherwise
        """
        if isinstance(predictor, (str, Path)):
            predictor = PermissibilityPredictor.load(predictor, self.device)
        check_same_spaces(predictor, self.observation_space, self.action_space)
        own, other = self.parts.as_dict(), predictor.parts.as_dict()
        if own != other:
            raise ValueError(
                f"The AP predictor has the `action_parts` {other}, but this model has {own}: give the model those of "
                "the predictor, and an AP function that labels them."
            )
        check_statistics(predictor.about.get("statistics"), self.get_vec_normalize_env())
        self.predictor, self._predictor_architecture = make_predictor(self, {}, predictor)
        # `load` builds the same predictor.
        self.predictor_kwargs = {**self.predictor.arguments, **(self.predictor_kwargs or {})}
        self.validation_accuracy = float(predictor.about.get("accuracy", float("nan")))
        if self.predictor.fitted:
            self._expect_familiarity()

    def save_predictor(self, path: str | Path) -> None:
        """Writes E alone, with its accuracy and the statistics of VecNormalize if there are any, for `predictor=`."""
        if self.env is None:
            raise ValueError(
                "This model has no environment, so that it is not known how its observations were normalised: load it "
                "with one, `load(path, env)`."
            )
        self.describe_predictor()
        self.predictor.save(path)

    def describe_predictor(self) -> None:
        """Notes with E how accurate it is, in which states, and how its observations were normalised."""
        statistics = statistics_of(self.get_vec_normalize_env())
        source = self.knowledge if len(self.knowledge) or self.knowledge.prior is None else self.knowledge.prior
        states = some_states(source) or self.predictor.about.get("states")
        self.predictor.about = {
            "accuracy": float(self.validation_accuracy),
            "statistics": statistics,
            "states": states,
        }

    def fit_predictor(self, epochs: int = 50, patience: int = 5, progress_bar: bool = False) -> PredictorReport:
        """Fits E to what is known before the first step, until it predicts held-out labels no better.

        Afterwards E is trusted as far as its accuracy goes, so that ``t_k`` and ``learning_starts`` may be 0.

        :param epochs: maximum number of passes over the training examples, each of at least 200 mini-batches
        :param patience: passes without a lower held-out loss after which it ends; the best weights are kept
        :return: balanced accuracy and calibration on held-out examples
        :raise ValueError: if there are too few labelled actions of both classes
        """
        source = self.knowledge.prior or self.knowledge
        if min(source.counts("train")) < self.min_per_class or min(source.counts("validation")) < 1:
            few = " and ".join(map(str, source.counts("train")))
            raise ValueError(
                f"E cannot be fitted to {few} non-permissible and permissible actions: it needs at least "
                f"{self.min_per_class} of each class (`min_per_class`), from `add_knowledge` or `learn`."
            )
        for name, value in (("epochs", epochs), ("patience", patience)):
            if value < 1:
                raise ValueError(f"`{name}` must be at least 1, but is {value!r}.")
        self._begin_statistics(source)
        passes: Iterable[int] = range(1, epochs + 1)
        if progress_bar:
            passes = with_progress(passes, epochs)
        report = fit_until_best(
            self.predictor, source, self.dataset_size, passes, patience, self.get_vec_normalize_env()
        )
        self.validation_accuracy = report.accuracy
        self.describe_predictor()
        self._expect_familiarity()
        return report
