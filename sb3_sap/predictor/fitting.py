"""Fits an AP predictor before the first step, until it predicts held-out labels no better."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

from stable_baselines3.common.vec_env import VecNormalize

from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.measuring import measure
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.reports import PredictorReport

#: Maximum number of held-out examples on which E is measured.
MEASURED = 2_000

#: Minimum number of mini-batches between two measurements: the loss of a new network stands still for some hundred.
UPDATES = 200


def fit_until_best(
    predictor: PermissibilityPredictor,
    source: KnowledgeBuffer,
    dataset_size: int,
    passes: Iterable[int],
    patience: int,
    normalize: VecNormalize | None = None,
) -> PredictorReport:
    """Passes over the training part, after each of which E is measured on the validation part.

    Where a pass has fewer than ``UPDATES`` mini-batches, as many passes as are needed count as one.

    :param source: labelled actions, with both classes in both parts
    :param dataset_size: N_E, examples of each fit
    :param passes: their numbers, from 1
    :param patience: passes without a lower held-out loss after which it ends
    :return: the report of the best pass, whose weights E has afterwards; one that was fitted before keeps its own if
        they are better
    """
    held_out = source.sample_own(min(MEASURED, 2 * min(source.counts("validation"))), "validation", normalize)
    enough = math.ceil(UPDATES / math.ceil(dataset_size / predictor.batch_size))
    fits = max(enough, round(sum(source.counts("train")) / dataset_size))
    best = measure(predictor, held_out) if predictor.fitted else None
    weights, since = copy.deepcopy(predictor.state_dict()), 0
    for number in passes:
        for _ in range(fits):
            predictor.fit(source.sample_own(dataset_size, "train", normalize))
        now, since = measure(predictor, held_out, number), since + 1
        if best is None or now.loss < best.loss:
            best, weights, since = now, copy.deepcopy(predictor.state_dict()), 0
        if since >= patience:
            break
    predictor.load_state_dict(weights)
    assert best is not None
    return best


def with_progress(items: Iterable[Any], total: int | None = None) -> Iterator[Any]:
    """The items, with the progress bar that SB3 shows; of batches it counts the rows."""
    from tqdm.rich import tqdm

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that its style is experimental
        bar = tqdm(total=total)
    with bar:
        for item in items:
            yield item
            bar.update(1 if isinstance(item, int) else len(item))
