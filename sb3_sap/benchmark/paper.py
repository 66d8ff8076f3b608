"""Table 2 of the paper as printed: laps of its agents on the four test tracks."""

from __future__ import annotations

from typing import NamedTuple

from sb3_sap.envs import get_track, score

#: Test tracks in the order of the table, by their directory names in TORCS.
TEST_TRACKS = ("eroad", "spring", "g-track-3", "ole-road-1")


class PaperLap(NamedTuple):
    """One entry of Table 2."""

    covered: float  # fraction of the lap; 1 where the paper prints Y
    total_reward: float


def _laps(*entries: tuple[float, float]) -> dict[str, PaperLap]:
    return {track: PaperLap(*entry) for track, entry in zip(TEST_TRACKS, entries, strict=True)}


#: Laps by training steps, then by algorithm, then by track.
TABLE_2: dict[int, dict[str, dict[str, PaperLap]]] = {
    3_000: {
        "ddpg": _laps((0.1759, 4460.96), (0.0430, 8258.29), (0.0575, 1574.31), (0.1682, 8784.68)),
        "ddpg_ce1": _laps((1, 23354.24), (1, 166150.64), (1, 19586.10), (1, 45586.42)),
        "ddpg_ce2": _laps((1, 53371.60), (0.4428, 162875.81), (1, 46948.97), (1, 105419.94)),
        "ddpg_ap": _laps((1, 49174.27), (1, 339468.72), (1, 42834.71), (1, 95606.01)),
        "ddpg_ap_ce2": _laps((1, 53009.64), (1, 363076.97), (1, 46253.10), (1, 104508.28)),
    },
    15_000: {
        "ddpg": _laps((1, 40785.05), (0.3668, 117519.69), (1, 37011.54), (1, 86275.80)),
        "ddpg_ce1": _laps((1, 51273.21), (0.3578, 125557.99), (1, 44657.91), (1, 100232.72)),
        "ddpg_ce2": _laps((1, 53653.04), (1, 368559.39), (1, 46975.31), (1, 105584.83)),
        "ddpg_ap": _laps((1, 55147.79), (1, 378242.15), (1, 48614.74), (1, 109311.58)),
        "ddpg_ap_ce2": _laps((1, 54848.50), (1, 374224.10), (1, 48101.77), (1, 107351.01)),
    },
}

#: Seconds between two actions of the paper's agents, derived from the totals of Table 2.
CONTROL_STEP = 0.2


def paper_score(track: str, total_reward: float) -> float:
    """S of a total reward of Table 2."""
    return score(total_reward, get_track(track).length, CONTROL_STEP)
