"""The automatic gearbox of racing: up near the red line, down where the lower gear pulls well below it."""

from __future__ import annotations

from sb3_sap.envs.torcs.readings import CarReadings

#: Fractions of the engine's red line: shift up above the first, down where the lower gear stays below the second.
SHIFT_UP, SHIFT_DOWN = 0.95, 0.75
#: Minimum time between two shifts, s. One takes 0.15 s, during which the engine does not pull.
SHIFT_TIME = 0.3


class Gearbox:
    """Chooses a gear by the engine's speed, as a client of the SCR server does by rpm.

    :param car: the car, on the road
    :param period: s between two decisions
    """

    def __init__(self, car: CarReadings, period: float):
        self._period = period
        gears = range(1, car.top_gear + 1)
        # Of each gear, the engine's speeds beyond which another is better, rad/s; index 0 is not used.
        self._up = [0.0, *(SHIFT_UP * car.red_line if gear < car.top_gear else float("inf") for gear in gears)]
        self._down = [0.0, *(SHIFT_DOWN * car.red_line / car.gear_step(gear) if gear > 1 else 0.0 for gear in gears)]
        self._gear = 1
        self._wait = 0.0  # s

    def gear(self, engine_speed: float) -> int:
        """The gear of the next period; ``engine_speed`` in rad/s."""
        self._wait -= self._period
        if self._wait <= 0:
            step = (engine_speed > self._up[self._gear]) - (engine_speed < self._down[self._gear])
            if step:
                self._gear += step
                self._wait = SHIFT_TIME
        return self._gear
