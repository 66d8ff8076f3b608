"""Potentials of the benchmark's shaped runs, against values that are computed in the head."""

import math

import gymnasium as gym
import numpy as np
import pytest

from sb3_sap.benchmark import potentials


@pytest.mark.parametrize(("size", "potential"), [(30, "centre_30"), (100, "centre_100"), (300, "centre_300")])
def test_lane_keeping_has_its_highest_potential_on_the_centre_line(size, potential):
    obs = np.array([[0.3, 0.0, 1, 0, 0], [0.3, -0.5, 1, 0, 0], [0.3, 1.0, 1, 0, 0]], dtype=np.float32)
    assert getattr(potentials, potential)(obs) == pytest.approx([0, -size / 2, -size])


@pytest.mark.parametrize(("size", "potential"), [(1, "energy_1"), (10, "energy_10"), (100, "energy_100")])
def test_the_energy_is_measured_from_the_valley_to_the_flag(size, potential):
    obs = np.array([[-math.pi / 6, 0.0], [0.45, 0.0]], dtype=np.float32)
    assert getattr(potentials, potential)(obs) == pytest.approx([0, size], abs=1e-5 * size)


def test_a_car_that_is_not_pushed_keeps_its_energy_and_one_that_pushes_gains_some():
    env = gym.make("MountainCarContinuous-v0").unwrapped

    def energies(push):
        env.reset(seed=0)
        env.state = np.array([-0.9, 0.0])
        states = [env.step(np.array([push * np.sign(env.state[1])], dtype=np.float32))[0] for _ in range(60)]
        return potentials.energy_1(np.stack(states))

    assert np.ptp(energies(0.0)) < 0.1
    assert np.ptp(energies(0.0)) < 0.3 * (energies(1.0)[-1] - energies(1.0)[0])
