"""The ways of using a label that are compared, from the simplest to the most demanding."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from sb3_sap.algorithms import GUIDED_ALGORITHMS, base_of
from sb3_sap.benchmark.learners import CLASSES
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.presets import preset, preset_names


@dataclass(frozen=True)
class Way:
    """One way of using a label.

    :param name: in tables and figures
    :param meaning: half a sentence
    :param settings: constructor arguments of the guided algorithm, beside the user's own
    :param code: the same arguments as a user writes them; empty for the base algorithm
    """

    name: str
    meaning: str
    settings: dict[str, Any] = field(default_factory=dict)
    code: str = ""


def ways(algo: str, potential: bool, finite: bool = False) -> list[Way]:
    """The ways that an algorithm knows, the simplest first.

    :param algo: RL Zoo's name of a guided algorithm
    :param potential: whether the user has given one
    :param finite: whether the actions are finitely many, which an on-policy algorithm can mask
    """
    cls = GUIDED_ALGORITHMS[algo].__name__
    on_policy = algo in ON_POLICY_ALGORITHMS
    penalty = preset("penalty", algo)
    # Without a penalty and without guidance, the algorithm equals its base to the bit, and counts the mistakes.
    base = {**penalty, "penalty": 0.0} | ({"predictor_epochs": 0} if on_policy else {})
    found = [
        Way("base", f"{CLASSES[base_of(algo)].partition(':')[2]} alone, without the label", base),
        Way("penalty", "the label as a reward penalty", penalty, f'**preset("penalty", {cls})'),
    ]
    if potential:
        code = f'**preset("penalty", {cls}) | {{"penalty": 0.0}}'
        found.append(Way("shaping", "the potential as reward shaping", base, code))
    if "loss" in preset_names(algo):
        beside = "" if on_policy else "the penalty, and "
        meaning = f"{beside}a loss on the learned predictor that fades"
        found.append(Way("loss", meaning, preset("loss", algo), f'**preset("loss", {cls})'))
    guided: dict[str, Any] = {"alpha": 1} if on_policy else {"refit_growth": 0.005, "n_candidates": 32}
    code = f"**{guided!r}"
    if not on_policy:
        found.append(Way("guidance", "Algorithm 1 of the paper", guided, code))
    elif finite:
        found.append(Way("mask", "the learned predictor as a mask of the actions", guided, code))
    elif "loss" not in preset_names(algo):
        found.append(Way("guidance", "the first draw that the learned predictor permits", guided, code))
    return found
