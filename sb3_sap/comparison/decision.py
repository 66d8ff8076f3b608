"""From the runs of a comparison to a decision."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from sb3_sap.common.arrays import FloatArray
from sb3_sap.common.files import atomic_path
from sb3_sap.comparison.ways import Way
from sb3_sap.evaluation.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement

#: A way is taken for better only if the lower end of the interval of its probability of improvement is above this.
SHOWN = 0.5
#: Number of runs of each way below which a rank test cannot tell even the clearest difference from chance: of two times
#: three runs, one order in twenty puts all of one way first.
FEW = 4


@dataclass(frozen=True)
class Comparison:
    """The result of :func:`~sb3_sap.comparison.compare.compare`.

    :param ways: what was compared, the simplest first
    :param evaluations: a row for each evaluation: ``way``, ``seed``, ``step``, ``return`` (the mean of the evaluation
        episodes) and ``mistakes`` (the share of non-permissible actions in training so far)
    :param lines: Python code of each way
    """

    ways: list[Way]
    evaluations: pd.DataFrame
    lines: dict[str, str]

    def scores(self, way: str) -> FloatArray:
        """Mean over the evaluations of each run of a way, which rewards learning soon and ending well: (runs, 1)."""
        own = self.evaluations[self.evaluations["way"] == way]
        means: FloatArray = own.groupby("seed")["return"].mean().to_numpy()[:, None]
        return means

    def final(self, way: str) -> FloatArray:
        """Mean return of each run of a way at the last evaluation: (runs, 1)."""
        own = self.evaluations[self.evaluations["way"] == way]
        values: FloatArray = own[own["step"] == own["step"].max()]["return"].to_numpy()[:, None]
        return values

    def improvement(self, way: str, over: str) -> tuple[float, float, float]:
        """How probably a run of one way has a higher score than a run of another, with its 95 % interval."""
        return probability_of_improvement(self.scores(way), self.scores(over))

    @property
    def best(self) -> Way:
        """The way with the highest interquartile mean of scores; of equal ones the simplest."""
        return max(self.ways, key=lambda way: interquartile_mean(self.scores(way.name)))

    @cached_property
    def choice(self) -> Way:
        """The simplest way than which the best is not shown to be better."""
        best = self.best
        return next(way for way in self.ways if way == best or self.improvement(best.name, way.name)[1] <= SHOWN)

    @property
    def table(self) -> pd.DataFrame:
        """A row for each way: the return over the training and at its end, as interquartile means over the runs with
        95 % intervals, the worst run at the end, and the share of non-permissible actions in training.
        """
        rows = []
        for way in self.ways:
            own = self.evaluations[self.evaluations["way"] == way.name]
            last = own[own["step"] == own["step"].max()]
            rows.append(
                {
                    "way": way.name,
                    "runs": own["seed"].nunique(),
                    "mean return": _with_interval(self.scores(way.name)),
                    "final return": _with_interval(self.final(way.name)),
                    "worst run": f"{self.final(way.name).min():.4g}",
                    "mistakes": f"{last['mistakes'].mean():.1%}",
                }
            )
        return pd.DataFrame(rows)

    @property
    def decision(self) -> str:
        """What to use, and how sure that is, in two or three sentences."""
        choice, best, base = self.choice, self.best, self.ways[0]
        sentences = [f"Use {choice.name}: {choice.meaning}."]
        if choice != base:
            p, low, high = self.improvement(choice.name, base.name)
            sentences.append(
                f"A run of it beats one of {base.name} with probability {p:.2f} "
                f"(95 % interval {low:.2f} to {high:.2f})."
            )
        if best != choice:
            p, low, high = self.improvement(best.name, choice.name)
            sentences.append(
                f"{best.name.capitalize()} did best, but is not shown to be better than {choice.name}, which is "
                f"simpler: probability {p:.2f} ({low:.2f} to {high:.2f}). More seeds would tell."
            )
        steps, runs = int(self.evaluations["step"].max()), len(self.scores(choice.name))
        sentences.append(f"This holds for {steps:,} steps.")
        if runs < FEW:
            sentences.append(f"With {runs} runs of each way it may be chance: repeat it with `seeds` of {FEW} or more.")
        return " ".join(sentences)

    @property
    def code(self) -> str:
        """Python code that trains with what was decided."""
        return self.lines[self.choice.name]

    def figure(self) -> Figure:
        """Mean return over training steps, a line for each way with its 95 % interval."""
        from sb3_sap.benchmark.reports.drawing import line_figure

        table = self.evaluations.rename(columns={"way": "configuration"})
        names = [way.name for way in self.ways]
        return line_figure(table, names, "step", "return", "training step", "mean return")

    def save(self, folder: Path) -> None:
        """Writes ``evaluations.csv``, ``table.csv``, ``curves.png``, ``decision.txt`` and ``train.py``."""
        write_evaluations(folder, self.evaluations)
        with atomic_path(folder / "table.csv") as path:
            self.table.to_csv(path, index=False)
        with atomic_path(folder / "curves.png") as path:
            self.figure().savefig(path, format="png", dpi=150)
        for name, text in (("decision.txt", self.decision), ("train.py", self.code)):
            with atomic_path(folder / name) as path:
                path.write_text(text + "\n", encoding="utf-8")


def write_evaluations(folder: Path, evaluations: pd.DataFrame) -> None:
    """Writes ``evaluations.csv``."""
    with atomic_path(folder / "evaluations.csv") as path:
        evaluations.to_csv(path, index=False)


def _with_interval(values: FloatArray) -> str:
    low, high = bootstrap_interval(values)
    return f"{interquartile_mean(values):.4g} [{low:.4g}, {high:.4g}]"
