"""The ways of using a label that are compared, from the simplest to the most demanding."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from sb3_sap.algorithms import ALGORITHMS, base_of
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


def ways(algo: str, potential: bool) -> list[Way]:
    """The ways that an algorithm knows, the simplest first.

    :param algo: RL Zoo's name of a guided algorithm
    :param potential: whether the user has given one
    """
    cls = ALGORITHMS[algo].__name__
    penalty = preset("penalty", algo)
    # Without a penalty and without guidance, the algorithm equals its base to the bit, and counts the mistakes.
    base = {**penalty, "penalty": 0.0}
    found = [
        Way("base", f"{base_of(algo).upper()} alone, without the label", base),
        Way("penalty", "the label as a reward penalty", penalty, f'**preset("penalty", {cls})'),
    ]
    if potential:
        code = f'**preset("penalty", {cls}) | {{"penalty": 0.0}}'
        found.append(Way("shaping", "the potential as reward shaping", base, code))
    if "loss" in preset_names(algo):
        meaning = "the penalty, and a loss on the learned predictor that fades"
        found.append(Way("loss", meaning, preset("loss", algo), f'**preset("loss", {cls})'))
    guided = {"refit_growth": 0.005, "n_candidates": 32}
    found.append(Way("guidance", "Algorithm 1 of the paper", guided, f"**{guided!r}"))
    return found
