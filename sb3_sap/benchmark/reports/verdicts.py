"""How the claims of the paper are judged: measures of the five algorithms' runs, and verdicts by a stated rule."""

from __future__ import annotations

import math
from collections.abc import Callable

import pandas as pd

from sb3_sap.benchmark.figures import ACCURACY_STEPS, with_averages
from sb3_sap.benchmark.measures import median_reached
from sb3_sap.benchmark.results import Results
from sb3_sap.statistics import interquartile_mean

DDPG, CE1, CE2, AP, AP_CE2 = (f"{algo}:paper" for algo in ("ddpg", "ddpg_ce1", "ddpg_ce2", "ddpg_ap", "ddpg_ap_ce2"))
SPEED = 50.0
"""km/h, the default speed and the reward of a perfect step."""
RISEN = 0.8
"""Share of it from which a moving average counts as risen; and below which it has fallen again."""
LONG_EPISODE = 500
"""Steps of a training episode that make "a considerable amount of distance": 1.4 km."""

#: Our figure, in words, and whether it bears the claim out.
Judge = Callable[[Results], tuple[str, bool]]
#: A figure of each column.
Measure = Callable[[Results], dict[str, float]]


def medians(values: pd.Series) -> dict[str, float]:
    """Median over the seeds of each column; ``values`` is indexed by column and seed."""
    return {str(name): median_reached(runs)[0] for name, runs in values.groupby(level="column", sort=False)}


def risen_at(results: Results) -> dict[str, float]:
    """The step at which the moving average has risen; infinite if it never has."""
    curve = results.curve
    step = curve["step"].where((curve["reward"] >= RISEN * SPEED) & (curve["step"] >= 100), math.inf)
    return medians(step.groupby([curve["column"], curve["seed"]]).min())


def stable_from(results: Results) -> dict[str, float]:
    """The step from which the moving average stays risen; infinite if it has fallen at the end."""
    curve = results.curve.sort_values("step")
    low = curve[curve["reward"] < RISEN * SPEED].groupby(["column", "seed"])["step"].max()
    keys = [curve["column"], curve["seed"]]
    end = curve.groupby(keys)["step"].max()
    last_low = low.reindex(end.index).fillna(0).astype(float)
    return medians(last_low.where(last_low < end, math.inf))


def fluctuation(results: Results) -> dict[str, float]:
    """Standard deviation of the moving average in the second half."""
    late = results.curve[results.curve["step"] > results.curve["step"].max() / 2]
    return medians(late.groupby(["column", "seed"])["reward"].std(ddof=0))


def first_long_episode(results: Results) -> dict[str, float]:
    """The number of the first episode over a considerable distance."""
    episodes = with_averages(results.episodes)
    number = episodes["episode"].where(episodes["length"] >= LONG_EPISODE, math.inf)
    return medians(number.groupby([episodes["column"], episodes["seed"]]).min())


def last_lost_episode(results: Results) -> pd.Series:
    """The number of the last episode in which the car was lost, by column and seed; 0 if there is none."""
    episodes = with_averages(results.episodes)
    number = episodes["episode"].where(episodes["lost"], 0)
    return number.groupby([episodes["column"], episodes["seed"]]).max()


def laps(results: Results, name: str) -> tuple[int, int]:
    """Laps done of all, after the whole training."""
    done = results.final_laps().query("column == @name")["lap_done"]
    return int(done.sum()), len(done)


def rewards(results: Results) -> pd.DataFrame:
    """Interquartile mean of the total reward over seeds: columns by track."""
    by = results.final_laps().groupby(["column", "track"], sort=False)["total_reward"]
    return by.apply(lambda total: interquartile_mean(total.to_numpy())).unstack()


def _told(figures: dict[str, float], digits: int = 0) -> str:
    return ", ".join(
        f"{name.partition(':')[0]} {'never' if math.isinf(value) else f'{value:,.{digits}f}'}"
        for name, value in figures.items()
    )


def smallest(measure: Measure, name: str, limit: float = math.inf) -> Judge:
    def judge(results: Results) -> tuple[str, bool]:
        figures = measure(results)
        others = [value for other, value in figures.items() if other != name]
        return _told(figures), figures[name] < min(others) and figures[name] <= limit

    return judge


def ordered(measure: Measure, *pairs: tuple[str, str], factor: float = 1.0, digits: int = 0) -> Judge:
    """For every pair, the measure of the first is below that of the second over ``factor``."""

    def judge(results: Results) -> tuple[str, bool]:
        figures = measure(results)
        return _told(figures, digits), all(factor * figures[a] < figures[b] for a, b in pairs)

    return judge


def more_than_120(results: Results) -> tuple[str, bool]:
    number = first_long_episode(results)[DDPG]
    return _told({DDPG: number}), number > 120


def never_lost_after(name: str, limit: int) -> Judge:
    def judge(results: Results) -> tuple[str, bool]:
        last = last_lost_episode(results)[name]
        within = int((last <= limit).sum())
        return f"median {last.median():g}, {within} of {len(last)} seeds within {limit}", within == len(last)

    return judge


def _accuracy(results: Results) -> pd.DataFrame:
    curve = results.curve[(results.curve["step"] <= ACCURACY_STEPS) & results.curve["accuracy"].notna()]
    return curve[curve["column"] == AP].astype({"accuracy": float, "lowest_accuracy": float})


def always_above_70(results: Results) -> tuple[str, bool]:
    curve = _accuracy(results)
    share = (curve["accuracy"] >= 0.7).mean()
    lowest = curve["lowest_accuracy"].min()
    return f"lowest {lowest:.1%}; {share:.0%} of the points at or above 70 %", lowest >= 0.7


def average_80(results: Results) -> tuple[str, bool]:
    mean = _accuracy(results)["accuracy"].mean()
    return f"{mean:.1%}", mean >= 0.795


def laps_done(expected: dict[str, bool]) -> Judge:
    """Whether each column completes all of its laps, or, where that is expected, not all."""

    def judge(results: Results) -> tuple[str, bool]:
        found = {name: laps(results, name) for name in expected}
        figure = ", ".join(f"{name.partition(':')[0]} {done} of {total}" for name, (done, total) in found.items())
        return figure, all((done == total) == expected[name] for name, (done, total) in found.items())

    return judge


def no_lap(results: Results) -> tuple[str, bool]:
    done, total = laps(results, DDPG)
    return f"{done} of {total}", done == 0


def ce1_low(results: Results) -> tuple[str, bool]:
    done, total = laps(results, CE1)
    means = rewards(results).mean(axis=1)
    share = means[CE1] / means[AP]
    return f"{done} of {total} laps, {share:.0%} of DDPG-AP's reward", done == total and share < 0.6


def ce2_but_spring(results: Results) -> tuple[str, bool]:
    final = results.final_laps().query("column == @CE2", local_dict={"CE2": CE2})
    by_track = final.groupby("track")["lap_done"].agg(["sum", "size"])
    spring = by_track.loc["spring"]
    others = by_track.drop("spring")
    figure = f"Spring {spring['sum']} of {spring['size']}, others {others['sum'].sum()} of {others['size'].sum()}"
    return figure, bool(spring["sum"] < spring["size"] and others["sum"].sum() == others["size"].sum())


def highest(name: str) -> Judge:
    def judge(results: Results) -> tuple[str, bool]:
        totals = rewards(results)
        best = {str(track): str(totals[track].idxmax()) for track in totals}
        figure = ", ".join(f"{track}: {winner.partition(':')[0]}" for track, winner in best.items())
        return figure, all(winner == name for winner in best.values())

    return judge


def ce2_below(results: Results) -> tuple[str, bool]:
    means = rewards(results).mean(axis=1)
    figures = {name: float(means[name]) for name in (CE2, AP, AP_CE2)}
    return _told(figures), figures[CE2] < min(figures[AP], figures[AP_CE2])
