"""Measures what the car of sap/TorcsRacing-v0 can do: its deceleration under full brake, and its lateral acceleration
with the wheel turned. The decelerations in sb3_sap/tasks/racing.py are chosen by these.

python measurements/car_limits.py [CAR]
"""

import math
import sys

from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.torcs.gearbox import Gearbox
from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.torcs.throttle import PERIOD, PERIOD_TICKS
from sb3_sap.envs.units import KMH

#: A wide oval.
TRACK, PLACE = "a-speedway", 300.0
BRAKES, STEERING = (0.3, 0.5, 0.8, 1.0), (0.1, 0.3, 0.6, 1.0)
#: Speeds at which braking and turning begin, and at which braking is reported, km/h.
FAST, SLOW, REPORTED = 180.0, 80.0, (160.0, 120.0, 80.0, 60.0)


def drive(car: Physics, gearbox: Gearbox, steering: float, pedal: float) -> None:
    """Drives on for one period."""
    steering = min(max(steering, -1.0), 1.0)
    car.control(steering, max(pedal, 0.0), max(-pedal, 0.0), gear=gearbox.gear(car.engine_speed))
    car.advance(PERIOD_TICKS)


def speed_up(car: Physics, speed: float) -> Gearbox:
    """From rest to a speed, km/h, along the road."""
    car.place(PLACE)
    gearbox = Gearbox(car, PERIOD)
    while car.velocity[0] * KMH < speed:
        drive(car, gearbox, straight(car), 0.9)
    return gearbox


def straight(car: Physics) -> float:
    """Steering along the road."""
    return car.angle / STEERING_LOCK - 0.1 * car.track_pos


def braking(car: Physics, brake: float) -> dict[float, float]:
    """Decelerations, m/s², at the reported speeds."""
    gearbox = speed_up(car, FAST)
    speeds = [car.velocity[0]]
    while speeds[-1] > 5:
        drive(car, gearbox, straight(car), -brake)
        speeds.append(car.velocity[0])
    found = {}
    for speed in REPORTED:
        # Over a tenth of a second from where the speed is reached.
        first = next(i for i, value in enumerate(speeds) if value * KMH <= speed)
        last = min(first + 5, len(speeds) - 1)
        found[speed] = (speeds[first] - speeds[last]) / ((last - first) * PERIOD)
    return found


def turning(car: Physics, steering: float) -> float:
    """The largest lateral acceleration, m/s², of the first second, as a mean over a tenth of it."""
    gearbox = speed_up(car, SLOW)
    found = []
    for _ in range(10):
        before = car.pose[2]
        for _ in range(5):
            drive(car, gearbox, steering, 0.1)
        turned = math.remainder(car.pose[2] - before, math.tau)
        found.append(car.velocity[0] * turned / (5 * PERIOD))
    return max(found)


def main(name: str = "car1-trb1") -> None:
    """Prints both."""
    car = Physics(TRACK, name)
    for brake in BRAKES:
        print(f"brake {brake}: " + ", ".join(f"{a:.0f} m/s² at {v:.0f} km/h" for v, a in braking(car, brake).items()))
    for steering in STEERING:
        print(f"steering {steering}: {turning(car, steering):.0f} m/s² of lateral acceleration from {SLOW:.0f} km/h")


if __name__ == "__main__":
    main(*sys.argv[1:2])
