"""What the findings about an AP function mean, in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_sap.check import PermissibilityReport

#: Below this share, or above one minus it, examples of one class are rare.
RARE = 0.02
#: Examples of each class that a model wants before E is fitted: the default of ``min_per_class``.
MIN_PER_CLASS = 20
#: Below this accuracy the α gate of section 4.3 stays at ``alpha_low``.
GATE = 0.7
#: Changes of the label along one dimension of the action from which it is called rough.
ROUGH = 4.0
#: Share of states below which the action decides too rarely for guidance to have a choice.
FEW = 0.1
#: Accuracy below which what a classifier gains from the action, or loses without one of its dimensions, is noise.
NOISE = 0.02
#: Action dimensions that the report lists, the most informative first.
LISTED = 8
#: Share of a good policy's actions whose prohibition is small print or an alarm.
ALARM = 0.1


def describe(report: PermissibilityReport) -> str:
    """The report as a short text: a line for each finding, then the advice."""
    rows = [
        ("permissible of random actions", _percent(report.permissible_rate), f"{report.n_steps:,} steps"),
        ("label is a function of its own row", "yes" if report.own_row else "NO", ""),
        ("states where the action decides", _percent(report.action_matters), "returned to by seed and actions"),
        ("label changes along an action", _number(report.label_changes), "1 a threshold, 2 an interval"),
        ("held-out accuracy of a classifier", _percent(report.accuracy), f"the α gate wants {GATE:.0%}"),
        ("  of one that sees no action", _percent(report.accuracy_without_action), "the gap is what the action tells"),
        ("forbidden of the policy's actions", _percent(report.policy_forbidden), "Definition 3 wants 0 %"),
    ]
    lines = [f"  {name:<36}{value:>7}   {note}".rstrip() for name, value, note in rows]
    if report.action_informs is not None and len(report.action_informs) > 1:
        lines += ["  accuracy lost when one action dimension is shuffled:", f"    {_dimensions(report.action_informs)}"]
    advice = [f"  - {sentence}" for sentence in report.advice] or ["  Nothing speaks against this AP function."]
    return "\n".join(["check_permissibility", *lines, *advice])


def advise(report: PermissibilityReport) -> Iterator[str]:
    """What to look into, the gravest first."""
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
            "Asked again with the rows in another order, the AP function gave other labels: it must be a function of "
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
    accuracy, blind, informs = (
        report.accuracy or 0.0,
        report.accuracy_without_action or 0.0,
        report.action_informs or (),
    )
    seen = accuracy - blind >= NOISE  # whether the classifier makes use of the action
    if report.action_matters is not None and report.action_matters < FEW and not seen:
        yield (
            f"At {_percent(report.action_matters)} of the states that were tried does the label depend on the action: "
            "elsewhere no other action would have been better, so that guidance has nothing to choose. Label what the "
            "action itself changed, such as a difference between next_obs and obs, or judge the action by what it does "
            "to a velocity."
        )
    elif accuracy >= GATE and not seen:
        yield (
            f"A classifier that does not see the action foresees {blind:.0%} of the labels, and one that sees it "
            f"{accuracy:.0%}: the state says nearly everything about the label, so the predictor would hardly tell "
            "one action from another. Label what the action itself changed."
        )
    elif accuracy >= GATE and len(informs) > 1 and (idle := [i for i, lost in enumerate(informs) if lost < NOISE / 2]):
        yield (
            f"The classifier gains less than {NOISE / 2:.0%} from {_names(idle)}. Guidance replaces every dimension of "
            'an action, these at random, too: candidate_selection="nearest" changes them least.'
        )
    if report.label_changes is not None and report.label_changes > ROUGH:
        yield (
            f"Along one action dimension the label changes {report.label_changes:.1f} times: the predictor will hardly "
            "follow. Is there noise in the label, or a threshold amid rounding errors?"
        )
    if report.accuracy is not None and report.accuracy < GATE:
        yield (
            f"A classifier foresees {report.accuracy:.0%} of the labels from (obs, action), below the gate of "
            f"{GATE:.0%}: does the observation hold what the label depends on, velocities among it? Are its values of "
            "very different size (VecNormalize)?"
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


def _percent(share: float | None) -> str:
    return "—" if share is None else f"{share:.1%}"


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.1f}"


def _dimensions(informs: tuple[float, ...]) -> str:
    order = sorted(range(len(informs)), key=lambda i: -informs[i])
    listed = ", ".join(f"action[{i}] {max(informs[i], 0):.1%}" for i in order[:LISTED])
    return listed if len(order) <= LISTED else f"{listed}, and {len(order) - LISTED} more with less"


def _names(dimensions: list[int]) -> str:
    *others, last = [f"action[{i}]" for i in dimensions]
    return f"{', '.join(others)} and {last}" if others else last
