"""The AP function of sap/TorcsDriving-v0, on transitions computed by hand; TORCS is not needed."""

import numpy as np
import pytest

from sb3_sap.envs.torcs.driving import LOOK_AHEAD, ap_function, dawdles, lateral_velocity, too_fast

N_OBS = 6 + len(LOOK_AHEAD)


def observe(track_pos=0.0, angle=0.0, speed=50.0, radius_ahead=None, half_width=6.0):
    """An observation from raw values: rad, km/h, m."""
    obs = np.zeros((1, N_OBS))
    obs[0, :3] = angle, track_pos, speed / 50
    if radius_ahead:
        obs[0, 5 + LOOK_AHEAD.index(20.0)] = 1 / radius_ahead / 0.02
    obs[0, -1] = half_width / 10
    return obs


def permissible(before, after):
    return bool(ap_function(before, np.zeros((1, 2)), after)[0])


def test_lateral_velocity_is_positive_to_the_left():
    # 36 km/h are 10 m/s; a negative angle is a car that points to the left of the road
    assert lateral_velocity(observe(angle=-np.pi / 6, speed=36)) == pytest.approx([5.0])


def test_running_wide_is_not_permissible():
    # 0.6 m from the left edge, going there at 36 km/h · sin(0.1) = 1 m/s, and faster than before
    assert not permissible(observe(0.85, -0.05, 36), observe(0.9, -0.1, 36))
    # the same, but the step took lateral speed away
    assert permissible(observe(0.85, -0.15, 36), observe(0.9, -0.1, 36))
    # 3 m from the edge there is more than a second left
    assert permissible(observe(0.45, -0.05, 36), observe(0.5, -0.1, 36))
    # towards the middle
    assert permissible(observe(-0.95, -0.05, 36), observe(-0.9, -0.1, 36))


def test_both_edges_are_treated_alike():
    assert not permissible(observe(-0.85, 0.05, 36), observe(-0.9, 0.1, 36))


def test_accelerating_when_too_fast_for_the_curve_ahead_is_not_permissible():
    # A curve of 10 m radius holds 20 · 10 = 200 m²/s², and braking takes off 2 · 20 · 20 = 800 on the 20 m to it:
    # beyond √1000 = 31.6 m/s = 113.8 km/h no car can hold it.
    assert not too_fast(observe(speed=113, radius_ahead=10))[0]
    assert too_fast(observe(speed=115, radius_ahead=10))[0]
    assert not permissible(observe(speed=115, radius_ahead=10), observe(speed=116, radius_ahead=10))
    assert permissible(observe(speed=115, radius_ahead=10), observe(speed=114, radius_ahead=10))
    assert permissible(observe(speed=113, radius_ahead=10), observe(speed=116, radius_ahead=10))


def test_slowing_down_without_need_is_not_permissible():
    # 3 m/s² hold a curve of 12 m radius at 6 m/s = 21.6 km/h: no car needs to be slower than that.
    assert dawdles(observe(speed=21, radius_ahead=12))[0]
    assert not dawdles(observe(speed=22, radius_ahead=12))[0]
    assert not permissible(observe(speed=21, radius_ahead=12), observe(speed=20, radius_ahead=12))
    assert permissible(observe(speed=21, radius_ahead=12), observe(speed=21.5, radius_ahead=12))
    assert permissible(observe(speed=23, radius_ahead=12), observe(speed=22, radius_ahead=12))
    # On a straight of 150 m: √(2 · 3 · 150) = 30 m/s = 108 km/h can be stopped within sight.
    assert dawdles(observe(speed=107))[0]
    assert not dawdles(observe(speed=109))[0]
    # badly placed, slowing down may be right
    assert permissible(observe(0.6, 0.0, 21, radius_ahead=12), observe(0.6, 0.0, 20, radius_ahead=12))
    assert permissible(observe(0.0, 0.3, 21, radius_ahead=12), observe(0.0, 0.3, 20, radius_ahead=12))


def test_ap_function_gives_one_label_per_row():
    rows = np.concatenate([observe(0.85, -0.05, 36), observe()])
    after = np.concatenate([observe(0.9, -0.1, 36), observe()])
    assert ap_function(rows, np.zeros((2, 2)), after).tolist() == [False, True]
