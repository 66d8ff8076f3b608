"""AP functions of well-known environments beyond lane keeping, each with an argument for it, or marked as a heuristic.

Any of them is given to a guided algorithm by its name, ``ap_function="sb3_sap.tasks.mountain_car_continuous"``. They
use what the environments return by default, unless their docstring names an option.
"""

from sb3_sap.tasks.driving import highway, parking
from sb3_sap.tasks.energy import acrobot, mountain_car, mountain_car_continuous
from sb3_sap.tasks.pendulum import pendulum_energy, pendulum_height, pendulum_torque
from sb3_sap.tasks.racetrack import racetrack
from sb3_sap.tasks.racing import RACING_PARTS, racing, racing_whole
from sb3_sap.tasks.reach import fetch_reach, fetch_reach_axes, nearness
from sb3_sap.tasks.taxi import taxi

__all__ = [
    "RACING_PARTS",
    "acrobot",
    "fetch_reach",
    "fetch_reach_axes",
    "highway",
    "mountain_car",
    "mountain_car_continuous",
    "nearness",
    "parking",
    "pendulum_energy",
    "pendulum_height",
    "pendulum_torque",
    "racetrack",
    "racing",
    "racing_whole",
    "taxi",
]
