"""Searches the gains of linear feedback: the best of a grid on Wheel-2, then refined; no other track is driven.

python measurements/linear_gains.py highway|torcs   # prints the gains for sb3_sap/benchmark/linear.py
"""

import itertools
import sys

from scipy.optimize import minimize

from sb3_sap.benchmark.linear import LinearFeedback
from sb3_sap.evaluation.laps import lap, lap_env

ANGLE = (1.0, 2.0, 3.0, 4.0, 6.0)
TRACK_POS = (-1.0, -2.0, -4.0, -8.0, -16.0)
SPEED_Y = (-8.0, -4.0, 0.0, 1.0, 4.0)
REFINEMENTS = 80


def main(simulator: str) -> None:
    """Searches, and prints S and the gains, rounded to one decimal."""
    env = lap_env("wheel-2", simulator)

    def loss(gains) -> float:
        return -lap(LinearFeedback(*gains), env, "wheel-2").score

    best = min(itertools.product(ANGLE, TRACK_POS, SPEED_Y), key=loss)
    print(f"grid: S {-loss(best):.4f} with {best}")
    found = minimize(loss, best, method="Nelder-Mead", options={"maxfev": REFINEMENTS})
    gains = [round(float(gain), 1) for gain in found.x]
    print(f"refined: S {-loss(gains):.4f} with {gains}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
