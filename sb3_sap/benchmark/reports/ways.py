"""The page that compares ways of using the label: none, as a reward penalty, a loss beside it, and guidance."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sap.benchmark.configurations import Configuration
from sb3_sap.benchmark.learners import plain_name
from sb3_sap.benchmark.reports.drawing import line_figure
from sb3_sap.benchmark.reports.measures import LOST, median_reached, ms_per_step, steps_to_competence
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_figure, write_page
from sb3_sap.benchmark.reports.reference import reference_share
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.benchmark.reports.returns import steps_to_return
from sb3_sap.benchmark.task_settings import target_return
from sb3_sap.common.arrays import FloatArray
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.evaluation.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS

#: Shares of the training after which the score is told.
SHARES = (0.25, 0.5, 1.0)
#: The same where the first steps matter.
EARLY_SHARES = (0.2, 0.3, 0.5, 0.7, 1.0)
#: The presets of a penalty alone.
PENALTY = "base+penalty"
#: The override that makes it the base algorithm.
NO_PENALTY = ("penalty", "0")
#: Returns up to this size are told with two digits.
SMALL = 10.0
#: S on every track from which a lap-driving policy has learned the task.
GOOD = 0.95
#: What the settings of the configurations have in common.
SHARED = "All configurations of an algorithm share its base settings."
EQUAL_BUDGET = {
    "equal_budget": (
        "Each configuration is the best of twelve draws of learning rate, γ, noise and a knob of its own, which "
        "`measurements/equal_budget.py` made on design seeds and other tracks."
    ),
    "on_policy": (
        "Each configuration with overrides is the best of eight draws of learning rate, γ, length of a rollout, first "
        "deviation of the policy and a knob of its own, which `measurements/equal_budget.py` made on design seeds and "
        "other tracks; the presets were among the draws."
    ),
}
#: The penalty of the presets of `zoo_configs`, where configurations are on-policy, off-policy, or of both kinds.
SIZES = {
    frozenset({True}): "a quarter of the root mean square of the rewards",
    frozenset({False}): "the root mean square of the rewards",
    frozenset({True, False}): "the root mean square of the rewards, on-policy a quarter of it",
}
NOTE = (
    "{settings} Those with `penalty` or `loss` explore as the base "
    "does, `fast` and `task` are guided. A `penalty` is of so much, or by default of {size}, "
    "and `penalty=0` is the base algorithm. Scores are of {acting}: the mean over the test {tests}, as "
    "the interquartile mean over seeds with its 95 % bootstrap interval. Steps until the {goal} are medians over "
    "seeds, in which a run that never gets there counts as infinite, and the number of seeds that do is in brackets. "
    "*Mistakes* is the share of all training steps that the AP function labels non-permissible, and *in excess* what "
    "it exceeds the share of a good policy by, which is {reference:.1%} ({good}). Milliseconds per step are processor "
    "time.\n"
)


def ways(results: Results, folder: Path, command: str, kind: str = "ways") -> None:
    """Writes ``KIND.md``, ``KIND.svg``, ``KIND.csv`` with a row for every run and checkpoint, and
    ``KIND_improvement.csv``.
    """
    laps = results.simulator in ENVIRONMENTS
    scores = run_scores(results)
    write_csv(folder / f"{kind}.csv", scores.round(6))
    write_figure(
        folder / f"{kind}.svg",
        line_figure(scores, results.names, "checkpoint", "score", "training step", "S" if laps else "mean return"),
    )
    reference = reference_share(results, scores)
    shares = EARLY_SHARES if kind == "starts" else SHARES
    rows = [_row(results, scores, name, reference, shares, kind) for name in results.names]
    improvements = improvement(results, scores, kind)
    if not improvements.empty:
        write_csv(folder / f"{kind}_improvement.csv", improvements.round(6))
    on_policy = frozenset(each.algo in ON_POLICY_ALGORITHMS for each in results.configurations)
    goal = f"every lap done with S of at least {GOOD}" if laps else f"mean return {target_return(results.simulator):g}"
    note = NOTE.format(
        settings=EQUAL_BUDGET.get(kind, SHARED),
        size=SIZES[on_policy],
        acting="the actor alone" if laps or True not in on_policy else "the policy, on-policy with learned masks",
        reference=reference,
        good="linear feedback" if laps else "the configuration that ends best",
        tests="tracks (without Spring, whose long lap is driven at the end only)" if laps else "episodes",
        goal=f"goal ({goal})",
    )
    parts = [f"![Scores over training steps]({kind}.svg)\n", markdown(pd.DataFrame(rows)), note]
    of = {"wrong_labels": "of the base algorithm", "starts": "from scratch with the loss"}.get(kind, "with the penalty")
    if not improvements.empty:
        parts += [f"## Probability that a run ends better than one {of}\n"]
        intervals = [f"{p:.2f} [{low:.2f}, {high:.2f}]" for p, low, high in improvements.iloc[:, 2:].to_numpy()]
        parts += [markdown(improvements.iloc[:, :2].assign(**{"probability of improvement": intervals}))]
    title = {
        "wrong_labels": "Ways of using the label, with wrong labels",
        "starts": "What a run begins with",
        "parts": "Labels for parts of the action, and for the whole",
        "failing": "How many runs with the penalty fail",
        "equal_budget": "Ways of using the label, tuned with the same budget",
    }.get(kind, "Ways of using the label")
    title = f"{title} ({results.simulator}, {results.steps:,} steps)"
    write_page(folder / f"{kind}.md", title, parts, results, command)


def run_scores(results: Results) -> pd.DataFrame:
    """Mean score over episodes, or the tracks that are driven at every checkpoint.

    :return: columns ``configuration``, ``seed``, ``checkpoint`` and ``score``
    """
    keys = ["configuration", "seed", "checkpoint"]
    first = results.laps["checkpoint"] == results.laps["checkpoint"].min()
    always = results.laps["track"].isin(results.laps["track"][first])
    return results.laps[always].groupby(keys, sort=False)["score"].mean().reset_index()


def peer(ours: Configuration, kind: str, among: list[Configuration]) -> Configuration | None:
    """What a configuration is compared with: the penalty of the same algorithm, without overrides if there is one; of
    wrong labels, the algorithm without a penalty; of starts, the loss without a start.

    :param among: the configurations of the page
    """
    if kind == "starts":
        kept = [(key, "nothing" if key == "start" else value) for key, value in ours.overrides if key != "source"]
        other = Configuration(ours.algo, "base+loss", tuple(kept))
        return other if other in among else None
    without = kind == "wrong_labels"
    peers = [
        each
        for each in among
        if each.preset == PENALTY
        and plain_name(each.algo) == plain_name(ours.algo)
        and (NO_PENALTY in each.overrides) == without
    ]
    return min(peers, key=lambda each: len(each.overrides), default=None)


def improvement(results: Results, scores: pd.DataFrame, kind: str = "ways") -> pd.DataFrame:
    """Compares each configuration at the end with its `peer`.

    :return: columns ``configuration``, ``against``, ``probability``, ``low`` and ``high``
    """
    rows = []
    for ours in results.configurations:
        other = peer(ours, kind, results.configurations)
        if other is not None and other != ours:
            estimate = probability_of_improvement(_at(scores, ours.name, 1.0), _at(scores, other.name, 1.0))
            rows.append([ours.name, other.name, *estimate])
    return pd.DataFrame(rows, columns=["configuration", "against", "probability", "low", "high"])


def _at(scores: pd.DataFrame, name: str, share: float) -> FloatArray:
    """Scores of a configuration's runs at the last checkpoint up to a share of the training: (runs, 1)."""
    own = scores[scores["configuration"] == name]
    last = own["checkpoint"].max()
    checkpoint = own["checkpoint"][own["checkpoint"] <= share * last].max()
    values: FloatArray = own[own["checkpoint"] == checkpoint]["score"].to_numpy()[:, None]  # empty if there is none
    return values


def _laps_after(laps: pd.DataFrame, last: int) -> dict[str, str]:
    """How many runs do every lap, and the S of the worst lap, after half of the training and at its end."""
    row = {}
    for checkpoint in (last // 2, last):
        own = laps[laps["checkpoint"] == checkpoint]
        done = own.groupby("seed")["lap_done"].all().astype(bool)
        row[f"laps done after {checkpoint:,}"] = f"{done.sum()} of {len(done)} runs"
        row[f"worst lap after {checkpoint:,}"] = f"{own['score'].min():.3f}"
    return row


def _row(
    results: Results, scores: pd.DataFrame, name: str, reference: float, shares: tuple[float, ...], kind: str
) -> dict[str, str]:
    own = scores[scores["configuration"] == name]
    last = own["checkpoint"].max()
    row = {"configuration": name, "seeds": str(own["seed"].nunique())}
    digits = 3 if results.simulator in ENVIRONMENTS else 1 if scores["score"].abs().max() > SMALL else 2
    for share in shares:
        values = _at(scores, name, share)
        if len(values) == 0:  # no evaluation so early
            continue
        low, high = bootstrap_interval(values)
        row[f"after {share * last:,.0f}"] = (
            f"{interquartile_mean(values):.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
        )
    row["worst seed"] = f"{_at(scores, name, 1.0).min():.{digits}f}"
    if results.simulator in ENVIRONMENTS:
        laps = results.final_laps().query("configuration == @name", local_dict={"name": name})
        all_done = laps.groupby("seed")["lap_done"].all()
        if kind == "failing":
            row |= _laps_after(results.laps.query("configuration == @name", local_dict={"name": name}), last)
        row["runs that fail"] = f"{(~all_done.astype(bool)).sum()} of {len(all_done)}"
        reached = steps_to_competence(results.laps[results.laps["configuration"] == name], GOOD)
    else:
        reached = steps_to_return(own.rename(columns={"score": "return"}), target_return(results.simulator))
    median, number = median_reached(reached)
    row["steps until the goal"] = f"{median:,.0f} ({number})" if math.isfinite(median) else f"– ({number})"
    curve = results.curve[results.curve["configuration"] == name]
    if "mistakes" in curve and curve["mistakes"].notna().any():
        ends = curve.sort_values("step").groupby("seed").last()
        share = float((ends["mistakes"].astype(float) / ends["step"]).median())
        row |= {"mistakes": f"{share:.1%}", "in excess": f"{share - reference:.1%}"}
    if results.simulator in ENVIRONMENTS:
        episodes = results.episodes.query(
            "configuration == @name and ended in @lost", local_dict={"name": name, "lost": LOST}
        )
        lost = episodes.groupby("seed").size().reindex(own["seed"].unique(), fill_value=0)
        row["episodes lost"] = f"{lost.median():g}"
    milliseconds = ms_per_step(results.times[results.times["configuration"] == name]).median()
    return row | {"ms per step": "" if np.isnan(milliseconds) else f"{milliseconds:.1f}"}
