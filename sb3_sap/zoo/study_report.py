"""The report of a study: Markdown, CSV and pictures in a folder."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import TrialState

from sb3_sap.common.files import atomic_path
from sb3_sap.evaluation.plots import save
from sb3_sap.zoo import study_plots

#: Trials that the report lists.
TOP = 10


def write_report(study: optuna.Study, log_folder: str, algo: str, env_name: str, pictures: bool = True) -> Path:
    """Writes the report into a folder named after algorithm, environment and study, and returns it."""
    folder = Path(log_folder) / algo / f"report_{env_name}_{study.study_name}"
    return write_report_to(study, folder, pictures)


def write_report_to(study: optuna.Study, folder: Path, pictures: bool = True) -> Path:
    """Writes report.md, trials.csv and, where trials allow, history.png, importances.png and contour.png."""
    with atomic_path(folder / "trials.csv") as temporary:
        study.trials_dataframe().to_csv(temporary, index=False)
    done = study_plots.completed(study)
    if not done:
        raise ValueError(f"No trial of the study {study.study_name!r} has finished; {folder}/trials.csv lists them.")
    target = target_name(study)
    importance = _importance(study)
    drawn: list[str] = []
    if pictures:
        save(study_plots.history(study, target), folder / "history.png")
        drawn.append("history.png")
        if importance:
            save(study_plots.importances(importance), folder / "importances.png")
            drawn.append("importances.png")
        if all({"alpha", "t_k"} <= trial.params.keys() for trial in done):
            save(study_plots.contour(study, "alpha", "t_k", target), folder / "contour.png")
            drawn.append("contour.png")
    with atomic_path(folder / "report.md") as temporary:
        temporary.write_text(_markdown(study, target, importance, drawn), encoding="utf-8")
    return folder


def target_name(study: optuna.Study) -> str:
    """What the study maximises."""
    tracks = study.user_attrs.get("validation_tracks")
    return f"score S, mean of {', '.join(tracks)}" if tracks else "mean reward of the evaluation"


def markdown_table(header: list[str], rows: list[list[Any]]) -> list[str]:
    """A table as lines of Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(map(str, line)) + " |" for line in lines]


def formatted(value: Any) -> str:
    """A number with four digits; everything else as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _importance(study: optuna.Study) -> dict[str, float]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return optuna.importance.get_param_importances(study)
    except (ValueError, RuntimeError):
        return {}  # too few trials, or all alike


def _markdown(study: optuna.Study, target: str, importance: dict[str, float], drawn: list[str]) -> str:
    trials = study.get_trials(deepcopy=False)
    states = [f"{sum(t.state == state for t in trials)} {state.name.lower()}" for state in TrialState]
    best = sorted(study_plots.completed(study), key=lambda trial: float(trial.value or 0), reverse=True)[:TOP]
    names = list(dict.fromkeys(name for trial in best for name in trial.params))
    rows = [
        [
            t.number,
            formatted(t.value),
            *(formatted(t.params.get(name, "")) for name in names),
            t.user_attrs.get("seed", ""),
        ]
        for t in best
    ]
    lines = [
        f"# Study {study.study_name}",
        "",
        f"`{study.user_attrs.get('command', '')}`",
        "",
        f"Maximised: {target}. Trials: {', '.join(state for state in states if not state.startswith('0 '))}.",
        "The best of many noisy trials looks better than it is: `sb3-sap retest` trains it again on fresh seeds.",
        "",
        *markdown_table(["trial", "value", *names, "seed"], rows),
    ]
    if importance:
        lines += ["", *markdown_table(["parameter", "importance"], [[k, formatted(v)] for k, v in importance.items()])]
    lines += [line for name in drawn for line in ("", f"![{Path(name).stem}]({name})")]
    return "\n".join(lines) + "\n"
