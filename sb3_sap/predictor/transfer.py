"""Knowledge before the first step: transitions of elsewhere, and an AP predictor that was fitted elsewhere."""

from __future__ import annotations

import copy
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor

from sb3_sap.common.arrays import BoolArray, rows_of
from sb3_sap.common.errors import is_number
from sb3_sap.common.vec_envs import environment_layout, never_updated
from sb3_sap.permissibility import query_labels
from sb3_sap.predictor.building import make_knowledge, make_predictor
from sb3_sap.predictor.fitting import fit_until_best, with_progress
from sb3_sap.predictor.knowledge import PERMISSIBLE, KnowledgeBuffer
from sb3_sap.predictor.labelling import Labels
from sb3_sap.predictor.learned import LearnedPredictorMixin
from sb3_sap.predictor.measuring import Familiarity
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.reports import KnowledgeReport, PredictorReport
from sb3_sap.predictor.states import random_rows, some_states
from sb3_sap.predictor.weights import check_same_spaces, check_statistics, statistics_of
from sb3_sap.transitions.batch import Transitions, fitting
from sb3_sap.transitions.sources import batches_of
from sb3_sap.transitions.tables import Columns

Into = Literal["knowledge", "replay", "both"]


class PriorKnowledgeMixin(LearnedPredictorMixin):
    """Lets a model learn from transitions that somebody else made, before its first step.

    The further parameters are those of :class:`~sb3_sap.predictor.learned.LearnedPredictorMixin`.

    :param predictor: an AP predictor to begin with, or the file that :meth:`save_predictor` wrote. It must be of the
        same spaces, and goes on learning
    :param freeze_predictor: whether E is never fitted while the agent learns
    :param prior_share: share of each batch that comes from transitions of :meth:`add_knowledge`, in fits of E as soon
        as there are own examples of both classes, and in updates of the agent: 0.5 is half and half (Ball et al. 2023)
    """

    def __init__(
        self,
        *args: Any,
        predictor: PermissibilityPredictor | str | Path | None = None,
        freeze_predictor: bool = False,
        prior_share: float = 0.5,
        **kwargs: Any,
    ):
        self._given_predictor = predictor
        self.freeze_predictor = freeze_predictor
        self.prior_share = prior_share
        #: Of an E that has learned elsewhere with what is observed here; None: it has not, or was found to fit or not.
        self.familiarity: Familiarity | None = None
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        if not (is_number(self.prior_share) and 0 <= self.prior_share <= 1):
            raise ValueError(f"`prior_share` is a share from 0 to 1, but is {self.prior_share!r}.")
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

    def add_knowledge(
        self, source: Any, into: Into | None = None, columns: Columns | None = None, progress_bar: bool = False
    ) -> KnowledgeReport:
        """Takes in transitions that somebody else made: a driver's log, an old controller, another simulator.

        They are labelled by the AP function, unless they bring labels, and checked row by row. For E a balanced random
        sample of all is kept, as large as K and apart from it. In the replay buffer they get the model's penalty, and
        stay apart from the model's own transitions, too. If reading is interrupted, the model is as it was.

        :param source: see :func:`~sb3_sap.transitions.sources.batches_of`; in the environment's units
        :param into: ``"knowledge"``: E learns from them; ``"replay"``: the agent does, which needs rewards; ``"both"``.
            ``None``: both if there are rewards and the algorithm has a replay buffer
        :param columns: for a table, see :func:`~sb3_sap.transitions.tables.table_batches`
        :raise ValueError: with one sentence, if the source cannot be read or does not fit the environment
        """
        if into not in (None, "knowledge", "replay", "both"):
            raise ValueError(f'`into` must be "knowledge", "replay" or "both", but is {into!r}.')
        holder = self._label_holder()
        self._set_label_source(holder)  # a copied model has lost its AP function
        images = self.images
        batches: Iterable[Transitions] = batches_of(source, columns, images)
        if progress_bar:
            batches = with_progress(batches)
        prior = copy.deepcopy(self.knowledge.prior) or make_knowledge(self, prior=True)
        replay, rows, counts, refused = self._new_replay(into, source), 0, Counter[bool | None](), Counter[str]()
        for batch in batches:
            whole, sound, why = fitting(batch, self.observation_space, self.action_space)
            refused += why
            rows += len(batch)
            labels = self._labels(holder, whole, sound, images, into)
            scaled = self._scaled(whole.actions)
            if labels is not None and into != "replay":
                prior.add(_rows(whole.obs, sound), scaled.reshape(len(batch), -1)[sound], labels[sound])
            if labels is not None:
                of_all = np.asarray(labels.all(axis=1)) if labels.ndim > 1 else labels
                counts.update(of_all[sound].tolist())
            else:
                counts[None] += int(sound.sum())
            if replay is not None:
                replay.extend(whole, sound, scaled, labels)
        if rows == 0:
            raise ValueError(f"{source!r:.100} holds no transitions.")
        if not sum(counts.values()):
            reasons = ", ".join(f"{reason} ({n})" for reason, n in refused.items() if n)
            raise ValueError(f"All {rows} transitions were refused: {reasons}.")
        if into != "replay" and len(prior) > 0:
            self.knowledge.prior = prior  # type: ignore[assignment]
            self._expect_familiarity()
        kept = len(prior) if into != "replay" else 0
        pieces = 0 if replay is None else replay.attach()
        taken = 0 if replay is None else replay.rows
        missed = replay is not None and taken == 0
        return KnowledgeReport(rows, counts[True], counts[False], counts[None], taken, pieces, refused, kept, missed)

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

    def known_states(self, n: int) -> Iterator[Any]:
        """Batches of n observation tensors, without end, of states that E has learned in.

        :raise ValueError: if there are none, or E was not fitted
        """
        source = self.knowledge.prior or self.knowledge
        states = None if sum(source.counts("train")) else self.predictor.about.get("states")
        if not (self.predictor.fitted and (states or sum(source.counts("train")))):
            missing = "E is not fitted: call `fit_predictor` first" if len(source) else "nothing is known"
            raise ValueError(f"The policy cannot be taught, because {missing}.")
        self._begin_statistics(source)
        normalize = self.get_vec_normalize_env()
        while True:
            if states is None:
                obs = source.sample_own(n, "train", normalize, balanced=False).observations
            else:
                obs = random_rows(states, n, source.rng)
                obs = obs if normalize is None else normalize.normalize_obs(obs)
            yield obs_as_tensor(cast(Any, obs), self.device)

    @property
    def knows_permissible(self) -> bool:
        """Whether the log, or else K, has permissible actions."""
        return (self.knowledge.prior or self.knowledge).counts("train")[PERMISSIBLE] > 0

    def known_actions(self, n: int) -> Iterator[tuple[Any, th.Tensor]]:
        """Batches of n observation tensors and (n, action_dim) scaled permissible actions of the log or K.

        :raise ValueError: if there are none
        """
        source = self.knowledge.prior or self.knowledge
        if not self.knows_permissible:
            raise ValueError("The policy cannot imitate, because no permissible action is known: use `add_knowledge`.")
        self._begin_statistics(source)
        while True:
            obs, actions, _ = source.sample_class(PERMISSIBLE, n, "train", self.get_vec_normalize_env())
            yield obs_as_tensor(cast(Any, obs), self.device), th.as_tensor(actions, device=self.device)

    # ---------------------------------------------------------------- an E that does not fit

    def _begin_statistics(self, source: KnowledgeBuffer) -> None:
        """Gives a VecNormalize that has seen nothing the statistics of what is known."""
        env = self.get_vec_normalize_env()
        if env is None or not (env.norm_obs and env.training) or not never_updated(env):
            return
        known = source.training_observations()
        for key, moments in (env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}).items():
            moments.update(known[key])

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

    # ---------------------------------------------------------------- hooks and helpers

    def _set_label_source(self, holder: Labels) -> None:
        super()._set_label_source(holder)
        holder.knowledge.prior_share = self.prior_share

    def _new_replay(self, into: Into | None, source: Any) -> Any:
        """Where transitions for the agent's updates go; None: nowhere."""
        if into in ("replay", "both"):
            raise ValueError(
                f"`into` = {into!r} needs a replay buffer, which {type(self).__name__} has not: leave it out, so that "
                "E alone learns from them."
            )

    def _labels(
        self, holder: Labels, batch: Transitions, sound: BoolArray, images: tuple[str, ...], into: Into | None
    ) -> BoolArray | None:
        """(n,) labels; of rows that are not sound they mean nothing. ``None``: there are none, and none are needed."""
        parts = self.parts.names
        shape = (len(batch), len(parts)) if parts else (len(batch),)
        if batch.labels is not None:
            given = batch.labels[:, None] if len(parts) == 1 and batch.labels.ndim == 1 else batch.labels
            if given.shape != shape:
                raise ValueError(
                    f"The `labels` of the transitions have shape {batch.labels.shape}, but must have {shape}, "
                    f"one for each {'part of the action' if parts else 'transition'}."
                )
            return given
        if holder.ap_function is None or holder.pending is not None:
            if into == "replay" and not holder.shaping.penalises:
                return None
            if holder.pending is not None:
                raise ValueError(
                    "The transitions have no labels, and this model's `horizon` or `event` labels its own steps alone: "
                    "give `labels` with the transitions."
                )
            raise ValueError(
                "The transitions have no labels, and this model takes its own from `info`: pass `ap_function=` to the "
                "algorithm, or give `labels` with the transitions."
            )
        labels = np.zeros(shape, dtype=bool)
        if sound.any():
            before, after = (environment_layout(_rows(side, sound), images) for side in (batch.obs, batch.next_obs))
            actions = batch.actions[sound]
            labels[sound] = query_labels(holder.ap_function, "ap_function", before, actions, after, parts=parts)
        return labels

    def _scaled(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Actions as K and R hold them."""
        return self.policy.scale_action(actions) if isinstance(self.action_space, spaces.Box) else actions


def _rows(obs: Any, which: BoolArray) -> Any:
    return obs if which.all() else rows_of(obs, which)
