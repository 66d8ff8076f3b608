"""Measures control steps per second of the environments on TORCS through the whole Gymnasium stack, and of its physics.

The rates are per second of processor time of one core, each the fastest of several rounds: other programs on the
machine slow down the others. The cars drive at 50 km/h. The physics alone is an upper bound for everything.

python measurements/torcs_speed.py [TRACK]
"""

import functools
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import sb3_sap  # noqa: F401  # registers the environments
from sb3_sap.envs.torcs.physics import TICK

LANE_KEEPING, RACING = "sap/TorcsLaneKeeping-v0", "sap/TorcsRacing-v0"
CONTROL_STEPS = {LANE_KEEPING: (0.2, 0.02), RACING: (0.2, 0.1, 0.02)}
ROUNDS = 12
#: Time that is driven in a round, s, and ticks of the physics alone.
DRIVEN, TICKS = 60.0, 30_000
#: Speed, km/h, and the throttle below it.
SPEED, THROTTLE = 50.0, 0.3


def feedback(env_id: str) -> Callable[[Any], Any]:
    """Steering, and a pedal where there is one, which keep the car on the road at `SPEED`."""
    if env_id == LANE_KEEPING:
        gains = np.array([2.5 / 0.366519, -1.6, 0.0, 1.0, 0.0], dtype=np.float32)
        return lambda obs: np.clip(gains @ obs, -1, 1).reshape(1)
    gains = np.zeros(30, dtype=np.float32)
    gains[[0, 20, 22]] = 2.5 / 0.366519, -1.6, 2.0  # angle, trackPos, speedY

    def act(obs: Any) -> Any:
        steering = min(max(gains @ obs, -1.0), 1.0)
        return np.array([steering, THROTTLE * (obs[21] * 100 < SPEED)], dtype=np.float32)

    return act


def fastest(drive: Callable[[], object]) -> float:
    """Processor time of the fastest round, s."""
    times = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        drive()
        times.append(time.process_time() - begin)
    return min(times)


def drive(env: gym.Env[Any, Any], act: Callable[[Any], Any], steps: int) -> Callable[[], None]:
    """What drives on for a number of steps."""
    state = {"obs": env.reset(seed=0)[0]}

    def steps_of_a_round() -> None:
        obs = state["obs"]
        for _ in range(steps):
            obs, _, terminated, truncated, _ = env.step(act(obs))
            if terminated or truncated:
                obs, _ = env.reset()
        state["obs"] = obs

    return steps_of_a_round


def main(track: str = "wheel-2") -> None:
    """Drives with linear feedback, which remains on the road, and prints the rates."""
    for env_id, control_steps in CONTROL_STEPS.items():
        for control_step in control_steps:
            env = gym.make(env_id, track=track, control_step=control_step, laps=None, max_episode_steps=10**9)
            steps = round(DRIVEN / control_step)
            begun = drive(env, feedback(env_id), steps)
            begun()  # from rest to the speed
            rate = steps / fastest(begun)
            inner: Any = env.unwrapped
            simulation = inner.simulation if env_id == RACING else inner.simulator.simulation
            # From the state of the drive, with the controls held: on wheel-2 this is still on the road.
            alone = TICKS / fastest(functools.partial(simulation.advance, TICKS))
            share = rate * control_step / (alone * TICK)
            print(
                f"{env_id}, control step {control_step} s: {rate:,.0f} steps/s, {rate * control_step:,.0f}× real time; "
                f"the physics alone {alone * TICK:,.0f}× ({share:.0%})",
                flush=True,
            )
            env.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
