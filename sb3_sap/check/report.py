"""What :func:`~sb3_sap.check.check_permissibility` found, as data and as text."""

from __future__ import annotations

from dataclasses import dataclass, field

from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY

#: Action dimensions that the report lists, the most informative first.
LISTED = 8


@dataclass(frozen=True)
class PermissibilityReport:
    """What :func:`check_permissibility` found. ``None`` stands for what could not be measured."""

    #: Random steps.
    n_steps: int
    #: Share of random actions that are labelled permissible.
    permissible_rate: float
    #: Whether each label depends on its own transition alone, and is the same in a second call.
    own_row: bool
    #: Share of fixed states at which some of the actions are permissible and others are not; with several dimensions
    #: they are tried together. ``None``: the environment cannot be brought back to a state.
    action_matters: float | None
    #: Mean number of changes of the label along a sweep of one action dimension, at the states where it changes at all:
    #: 1 is a threshold, 2 an interval. ``None`` for discrete actions, too, which have no order.
    label_changes: float | None
    #: Balanced accuracy of a quick classifier on held-out random transitions. ``None``: one of the classes is too
    #: rare.
    accuracy: float | None
    #: The same of a classifier that does not see the action; where it is no lower, the action decides nothing.
    accuracy_without_action: float | None
    #: For each dimension of the flattened action, the accuracy that the classifier loses when it is shuffled among
    #: the held-out transitions; about 0 where it says nothing about the label.
    action_informs: tuple[float, ...] | None
    #: Share of the policy's own actions that are labelled non-permissible; by Definition 3 zero for a good policy.
    policy_forbidden: float | None
    #: What to look into, a sentence each; empty if no problems were found.
    advice: tuple[str, ...] = field(default=())

    def __str__(self) -> str:
        return _described(self)


def _described(report: PermissibilityReport) -> str:
    """A line for each finding, then the advice."""
    rows = [
        ("permissible of random actions", percent(report.permissible_rate), f"{report.n_steps:,} steps"),
        ("label is a function of its own row", "yes" if report.own_row else "NO", ""),
        ("states where the action decides", percent(report.action_matters), "returned to by seed and actions"),
        ("label changes along an action", _number(report.label_changes), "1 a threshold, 2 an interval"),
        ("held-out accuracy of a classifier", percent(report.accuracy), f"the α gate is at {SUFFICIENT_ACCURACY:.0%}"),
        (
            "  of one that sees no action",
            percent(report.accuracy_without_action),
            "the difference is due to the action",
        ),
        ("forbidden of the policy's actions", percent(report.policy_forbidden), "0 % by Definition 3"),
    ]
    lines = [f"  {name:<36}{value:>7}   {note}".rstrip() for name, value, note in rows]
    if report.action_informs is not None and len(report.action_informs) > 1:
        lines += ["  accuracy lost when one action dimension is shuffled:", f"    {_dimensions(report.action_informs)}"]
    advice = [f"  - {sentence}" for sentence in report.advice] or ["  No problems found."]
    return "\n".join(["check_permissibility", *lines, *advice])


def percent(share: float | None) -> str:
    return "—" if share is None else f"{share:.1%}"


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.1f}"


def _dimensions(informs: tuple[float, ...]) -> str:
    order = sorted(range(len(informs)), key=lambda i: -informs[i])
    listed = ", ".join(f"action[{i}] {max(informs[i], 0):.1%}" for i in order[:LISTED])
    return listed if len(order) <= LISTED else f"{listed}, and {len(order) - LISTED} more with less"
