"""Advice on an AP function, from the findings of a check."""

from __future__ import annotations

from collections.abc import Iterator

from sb3_sap.check.report import PermissibilityReport, percent
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY

#: Below this share, or above one minus it, examples of one class are rare.
RARE = 0.02
#: Examples of each class that K must hold before E is fitted: the default of ``min_per_class``.
MIN_PER_CLASS = 20
#: Number of changes of the label along one action dimension above which it is hard to learn.
ROUGH = 4.0
#: Share of states where the action decides the label, below which guidance hardly ever has a choice.
FEW = 0.1
#: Difference in accuracy that is noise, with and without the action; for one action dimension, half of it.
NOISE = 0.02
#: Share of the policy's actions labelled non-permissible above which a good policy contradicts the AP function.
ALARM = 0.1


def advise(report: PermissibilityReport) -> Iterator[str]:
    """What to look into, the most serious first."""
    rate = report.permissible_rate
    if rate in (0, 1):
        every = "permissible" if rate == 1 else "non-permissible"
        yield (
            f"Every random action was labelled {every}: from constant labels nothing can be learned, and training "
            "equals the unguided algorithm. Look at signs and units, or at whether random actions ever reach what is "
            "forbidden."
        )
        return
    if not report.own_row:
        yield (
            "Called again with the rows in another order, the AP function gave other labels: it must be a function of "
            "each row alone, without randomness, memory, or statistics over the batch, and must not write into its "
            "arguments."
        )
    if min(rate, 1 - rate) < RARE:
        steps = MIN_PER_CLASS / min(rate, 1 - rate)
        rarer = "permissible" if rate < 0.5 else "non-permissible"
        yield (
            f"Only {min(rate, 1 - rate):.1%} of random actions are {rarer}: the predictor first sees {MIN_PER_CLASS} "
            f"of them after about {steps:,.0f} steps. Plan for a longer run, or for labels that say more."
        )
    accuracy, without_action, informs = (
        report.accuracy or 0.0,
        report.accuracy_without_action or 0.0,
        report.action_informs or (),
    )
    uses_action = accuracy - without_action >= NOISE
    if report.action_matters is not None and report.action_matters < FEW and not uses_action:
        yield (
            f"At {percent(report.action_matters)} of the states that were tried does the label depend on the action: "
            "elsewhere every action has the same label, so that guidance has no choice. Label what the "
            "action itself changed, such as a difference between next_obs and obs, or judge the action by what it does "
            "to a velocity."
        )
    elif accuracy >= SUFFICIENT_ACCURACY and not uses_action:
        yield (
            f"A classifier that does not see the action predicts {without_action:.0%} of the labels, and one that "
            f"sees it {accuracy:.0%}: the state says nearly everything about the label, so the predictor would hardly "
            "tell one action from another. Label what the action itself changed."
        )
    elif accuracy >= SUFFICIENT_ACCURACY and len(informs) > 1 and (uninformative := _uninformative(informs)):
        yield (
            f"The classifier gains less than {NOISE / 2:.0%} from {_names(uninformative)}. Guidance replaces every "
            'dimension of an action, these at random, too: candidate_selection="nearest" changes them least.'
        )
    if report.label_changes is not None and report.label_changes > ROUGH:
        yield (
            f"Along one action dimension the label changes {report.label_changes:.1f} times: the predictor will hardly "
            "follow. Is there noise in the label, or a threshold amid rounding errors?"
        )
    if report.accuracy is not None and report.accuracy < SUFFICIENT_ACCURACY:
        yield (
            f"A classifier predicts {report.accuracy:.0%} of the labels from (obs, action), below the gate of "
            f"{SUFFICIENT_ACCURACY:.0%}: does the observation hold what the label depends on, velocities among it? Are "
            "its values of very different size (VecNormalize)?"
        )
    if report.policy_forbidden:
        yield (
            f"The AP function forbids {report.policy_forbidden:.1%} of your policy's own actions. "
            + (
                "If the policy is good, it takes good actions away: say False of fewer, for example only where the "
                "loss is beyond a small tolerance."
                if report.policy_forbidden > ALARM
                else "A little of this is common near an optimum, where every action makes things slightly worse; a "
                "small tolerance removes it."
            )
        )


def _uninformative(informs: tuple[float, ...]) -> list[int]:
    """The action dimensions without which the classifier loses next to nothing."""
    return [i for i, lost in enumerate(informs) if lost < NOISE / 2]


def _names(dimensions: list[int]) -> str:
    *others, last = [f"action[{i}]" for i in dimensions]
    return f"{', '.join(others)} and {last}" if others else last
