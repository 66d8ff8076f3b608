"""Holding the default speed (section 5.1): throttle, brake and gears, which the paper's agent does not control."""

from __future__ import annotations

from sb3_sap.envs.torcs.physics import Physics
from sb3_sap.envs.units import KMH

#: Ticks between two decisions (50 Hz). Shifting cuts the throttle command, so the controls are written each time.
PERIOD_TICKS = 10
#: Throttle per km/h below the target.
GAIN = 0.08
#: Throttle per km/h and second below it.
INTEGRAL_GAIN = 0.02
#: Speed above the target from which the brake helps, km/h.
BRAKE_MARGIN = 3.0
#: Brake per km/h above that.
BRAKE_GAIN = 0.05
#: The throttle is halved while the two rear wheels together spin so much faster than the front wheels, rad/s.
SLIP = 5.0
#: Fractions of the engine's red line: shift up above the first, down if the lower gear stays below the second.
SHIFT_UP, SHIFT_DOWN = 0.835, 0.7
#: Minimum time between two shifts, s.
SHIFT_TIME = 0.5
#: Time between two decisions, s: `PERIOD_TICKS` ticks.
PERIOD = 0.02


class SpeedHolder:
    """A proportional-integral throttle and an automatic gearbox.

    :param speed: target, km/h
    """

    def __init__(self, speed: float):
        self.speed = speed
        self.reset()

    def reset(self) -> None:
        """Starts again in first gear, with an empty integral."""
        self._integral = 0.0  # throttle
        self._gear = 1
        self._since_shift = SHIFT_TIME

    def controls(self, simulation: Physics) -> tuple[float, float, int]:
        """Throttle, brake and gear for the next period."""
        lack = self.speed - simulation.velocity[0] * KMH
        # Acceleration from rest says nothing about the throttle that holds the speed.
        if abs(lack) < self.speed / 5:
            self._integral = min(max(self._integral + INTEGRAL_GAIN * PERIOD * lack, 0.0), 1.0)
        throttle = min(max(GAIN * lack + self._integral, 0.0), 1.0)
        front_right, front_left, rear_right, rear_left = simulation.wheel_spins
        if rear_right + rear_left - front_right - front_left > SLIP:
            throttle /= 2
        brake = min(max(BRAKE_GAIN * (-lack - BRAKE_MARGIN), 0.0), 1.0)
        return throttle, brake, self.gear(simulation)

    def gear(self, simulation: Physics) -> int:
        """The gear of the next period, shifted by the engine's speed."""
        self._since_shift += PERIOD
        if self._since_shift >= SHIFT_TIME:
            revs = simulation.engine_speed / simulation.red_line
            up = revs > SHIFT_UP and self._gear < simulation.top_gear
            down = self._gear > 1 and revs * simulation.gear_step(self._gear) < SHIFT_DOWN
            step = up - down
            if step:
                self._gear += step
                self._since_shift = 0.0
        return self._gear
