"""Transitions that somebody else made: checked, labelled, and kept for the predictor and the agent."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from sb3_sap.common.arrays import BoolArray, rows_of
from sb3_sap.common.errors import is_number
from sb3_sap.common.vec_envs import environment_layout
from sb3_sap.permissibility import query_labels
from sb3_sap.predictor.building import make_knowledge
from sb3_sap.predictor.fitting import with_progress
from sb3_sap.predictor.known import KnownExamplesMixin
from sb3_sap.predictor.labelling import Labels
from sb3_sap.predictor.reports import KnowledgeReport
from sb3_sap.transitions.batch import Transitions, fitting
from sb3_sap.transitions.sources import batches_of
from sb3_sap.transitions.tables import Columns

Into = Literal["knowledge", "replay", "both"]


class ImportMixin(KnownExamplesMixin):
    """Takes in transitions of elsewhere.

    The further parameters are those of :class:`~sb3_sap.predictor.familiar.FamiliarityMixin`.

    :param prior_share: share of each batch that comes from transitions of :meth:`add_knowledge`, in fits of E as soon
        as there are own examples of both classes, and in updates of the agent: 0.5 is half and half (Ball et al. 2023)
    """

    def __init__(self, *args: Any, prior_share: float = 0.5, **kwargs: Any):
        self.prior_share = prior_share
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        if not (is_number(self.prior_share) and 0 <= self.prior_share <= 1):
            raise ValueError(f"`prior_share` is a share from 0 to 1, but is {self.prior_share!r}.")
        super()._setup_model()

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
