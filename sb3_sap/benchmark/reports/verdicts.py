"""Judges the claims of the paper: measures of its five algorithms, and criteria on them."""

from __future__ import annotations

import math
from collections.abc import Callable

import pandas as pd

from sb3_sap.benchmark.reports.figures import ACCURACY_STEPS, with_averages
from sb3_sap.benchmark.reports.measures import median_reached
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.evaluation.statistics import interquartile_mean
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY

DDPG, CE1, CE2, AP, AP_CE2 = (f"{algo}:paper" for algo in ("ddpg", "ddpg_ce1", "ddpg_ce2", "ddpg_ap", "ddpg_ap_ce2"))
#: Default speed in km/h, which is the reward of a perfect step.
SPEED = 50.0
#: Share of that speed from which a moving average counts as risen.
RISEN = 0.8
#: Steps of a training episode that are "a considerable amount of distance": 1.4 km.
LONG_EPISODE = 500

#: A function of results that returns our figure in words, and whether it confirms the claim.
Judge = Callable[[Results], tuple[str, bool]]
#: A function of results that returns a figure of each configuration by name.
Measure = Callable[[Results], dict[str, float]]


def medians(values: pd.Series) -> dict[str, float]:
    """Median over the seeds of each configuration; ``values`` is indexed by configuration and seed."""
    return {str(name): median_reached(runs)[0] for name, runs in values.groupby(level="configuration", sort=False)}


def risen_at(results: Results) -> dict[str, float]:
    """The step at which the moving average has risen, or infinity."""
    curve = results.curve
    step = curve["step"].where((curve["reward"] >= RISEN * SPEED) & (curve["step"] >= 100), math.inf)
    return medians(step.groupby([curve["configuration"], curve["seed"]]).min())


def stable_from(results: Results) -> dict[str, float]:
    """The step from which the moving average remains risen, or infinity if it ends below."""
    curve = results.curve.sort_values("step")
    low = curve[curve["reward"] < RISEN * SPEED].groupby(["configuration", "seed"])["step"].max()
    keys = [curve["configuration"], curve["seed"]]
    end = curve.groupby(keys)["step"].max()
    last_low = low.reindex(end.index).fillna(0).astype(float)
    return medians(last_low.where(last_low < end, math.inf))


def fluctuation(results: Results) -> dict[str, float]:
    """Standard deviation of the moving average in the second half."""
    late = results.curve[results.curve["step"] > results.curve["step"].max() / 2]
    return medians(late.groupby(["configuration", "seed"])["reward"].std(ddof=0))


def first_long_episode(results: Results) -> dict[str, float]:
    """The number of the first episode over a considerable distance."""
    episodes = with_averages(results.episodes)
    number = episodes["episode"].where(episodes["length"] >= LONG_EPISODE, math.inf)
    return medians(number.groupby([episodes["configuration"], episodes["seed"]]).min())


def last_lost_episode(results: Results) -> pd.Series:
    """The number of the last episode in which the car was lost, or 0; by configuration and seed."""
    episodes = with_averages(results.episodes)
    number = episodes["episode"].where(episodes["lost"], 0)
    return number.groupby([episodes["configuration"], episodes["seed"]]).max()


def laps(results: Results, name: str) -> tuple[int, int]:
    """Number of laps that were completed after the whole training, and number of laps."""
    done = results.final_laps().query("configuration == @name")["lap_done"]
    return int(done.sum()), len(done)


def rewards(results: Results) -> pd.DataFrame:
    """Interquartile mean of the total reward over seeds: one row per configuration, one column per track."""
    by = results.final_laps().groupby(["configuration", "track"], sort=False)["total_reward"]
    return by.apply(lambda total: interquartile_mean(total.to_numpy())).unstack()


def _in_words(figures: dict[str, float], digits: int = 0) -> str:
    return ", ".join(
        f"{name.partition(':')[0]} {'never' if math.isinf(value) else f'{value:,.{digits}f}'}"
        for name, value in figures.items()
    )


def smallest(measure: Measure, name: str, limit: float = math.inf) -> Judge:
    """Whether the measure of a configuration is below that of all others, and at most ``limit``."""

    def judge(results: Results) -> tuple[str, bool]:
        figures = measure(results)
        others = [value for other, value in figures.items() if other != name]
        return _in_words(figures), figures[name] < min(others) and figures[name] <= limit

    return judge


def ordered(measure: Measure, *pairs: tuple[str, str], factor: float = 1.0, digits: int = 0) -> Judge:
    """Whether, in every pair, ``factor`` times the measure of the first is below that of the second."""

    def judge(results: Results) -> tuple[str, bool]:
        figures = measure(results)
        return _in_words(figures, digits), all(factor * figures[a] < figures[b] for a, b in pairs)

    return judge


def more_than_120(results: Results) -> tuple[str, bool]:
    """Whether DDPG's first long episode comes after the 120th."""
    number = first_long_episode(results)[DDPG]
    return _in_words({DDPG: number}), number > 120


def never_lost_after(name: str, limit: int) -> Judge:
    """Whether, in every seed, no episode after number ``limit`` is lost."""

    def judge(results: Results) -> tuple[str, bool]:
        last = last_lost_episode(results)[name]
        within = int((last <= limit).sum())
        return f"median {last.median():g}, {within} of {len(last)} seeds within {limit}", within == len(last)

    return judge


def _accuracy(results: Results) -> pd.DataFrame:
    curve = results.curve[(results.curve["step"] <= ACCURACY_STEPS) & results.curve["accuracy"].notna()]
    return curve[curve["configuration"] == AP].astype({"accuracy": float, "lowest_accuracy": float})


def always_above_70(results: Results) -> tuple[str, bool]:
    """Whether no validation of E has an accuracy below 70 %."""
    curve = _accuracy(results)
    share = (curve["accuracy"] >= SUFFICIENT_ACCURACY).mean()
    lowest = curve["lowest_accuracy"].min()
    return f"lowest {lowest:.1%}; {share:.0%} of the points at or above 70 %", lowest >= SUFFICIENT_ACCURACY


def average_80(results: Results) -> tuple[str, bool]:
    """Whether the mean accuracy of E rounds to 80 % or more."""
    mean = _accuracy(results)["accuracy"].mean()
    return f"{mean:.1%}", mean >= 0.795


def laps_done(expected: dict[str, bool]) -> Judge:
    """Whether each configuration completes all of its laps where True is expected, and misses some where False is."""

    def judge(results: Results) -> tuple[str, bool]:
        found = {name: laps(results, name) for name in expected}
        figure = ", ".join(f"{name.partition(':')[0]} {done} of {total}" for name, (done, total) in found.items())
        return figure, all((done == total) == expected[name] for name, (done, total) in found.items())

    return judge


def no_lap(results: Results) -> tuple[str, bool]:
    """Whether DDPG completes no lap."""
    done, total = laps(results, DDPG)
    return f"{done} of {total}", done == 0


def ce1_low(results: Results) -> tuple[str, bool]:
    """Whether DDPG-CE1 completes all laps with less than 60 % of DDPG-AP's reward."""
    done, total = laps(results, CE1)
    means = rewards(results).mean(axis=1)
    share = means[CE1] / means[AP]
    return f"{done} of {total} laps, {share:.0%} of DDPG-AP's reward", done == total and share < 0.6


def ce2_but_spring(results: Results) -> tuple[str, bool]:
    """Whether DDPG-CE2 misses laps of Spring and of no other track."""
    final = results.final_laps().query("configuration == @CE2", local_dict={"CE2": CE2})
    by_track = final.groupby("track")["lap_done"].agg(["sum", "size"])
    spring = by_track.loc["spring"]
    others = by_track.drop("spring")
    figure = f"Spring {spring['sum']} of {spring['size']}, others {others['sum'].sum()} of {others['size'].sum()}"
    return figure, bool(spring["sum"] < spring["size"] and others["sum"].sum() == others["size"].sum())


def highest(name: str) -> Judge:
    """Whether a configuration has the highest reward on every track."""

    def judge(results: Results) -> tuple[str, bool]:
        totals = rewards(results)
        best = {str(track): str(totals[track].idxmax()) for track in totals}
        figure = ", ".join(f"{track}: {winner.partition(':')[0]}" for track, winner in best.items())
        return figure, all(winner == name for winner in best.values())

    return judge


def ce2_below(results: Results) -> tuple[str, bool]:
    """Whether DDPG-CE2's mean reward is below those of DDPG-AP and DDPG-(AP+CE2)."""
    means = rewards(results).mean(axis=1)
    figures = {name: float(means[name]) for name in (CE2, AP, AP_CE2)}
    return _in_words(figures), figures[CE2] < min(figures[AP], figures[AP_CE2])
