"""The AP functions of racing, on transitions computed by hand; TORCS is not needed."""

import numpy as np
import pytest

from sb3_sap.envs.torcs.range_finders import DIRECTIONS
from sb3_sap.envs.torcs.sensors import INDEX, TRACK, UNITS
from sb3_sap.tasks.racing import (
    ANGLE,
    RACING_PARTS,
    RANGE,
    SPEED,
    SPEED_X,
    SPEED_Y,
    TRACK_POS,
    free_view,
    lateral_speed,
    racing,
    racing_whole,
)
from sb3_sap.tasks.racing import DIRECTIONS as OWN_DIRECTIONS
from sb3_sap.tasks.racing import TRACK as OWN_TRACK


def observe(speed=20.0, sideways=0.0, angle=0.0, track_pos=0.0, view=100.0, direction=0.0, left=6.0, right=6.0):
    """An observation from raw values: m/s, rad, m; the longest range finder points to ``direction`` degrees."""
    obs = np.zeros((1, 30))
    obs[0, TRACK] = 5.0
    obs[0, INDEX["track[0]"]], obs[0, INDEX["track[18]"]] = left, right
    obs[0, INDEX[f"track[{9 - round(direction / 10)}]"]] = view
    obs[0, INDEX["angle"]], obs[0, INDEX["trackPos"]] = angle, track_pos
    obs[0, INDEX["speedX"]], obs[0, INDEX["speedY"]] = speed * 3.6, sideways * 3.6
    return obs / UNITS


def steering(before, action, after):
    return bool(racing(before, np.array([[action, 0.5]]), after)[0, 0])


def pedal(before, action, after):
    return bool(racing(before, np.array([[0.0, action]]), after)[0, 1])


def test_parts_are_the_columns():
    assert RACING_PARTS == {"steering": [0], "pedal": [1]}
    labels = racing(observe(), np.zeros((1, 2)), observe())
    assert labels.shape == (1, 2)
    assert labels.dtype == bool


def test_one_label_is_permissible_where_both_parts_are():
    before, after = observe(speed=40, view=40), observe(speed=40, view=40)  # 20 m/s² to stop
    actions = np.array([[0.0, 1.0], [0.0, -1.0]])
    before, after = np.repeat(before, 2, axis=0), np.repeat(after, 2, axis=0)
    assert racing(before, actions, after).tolist() == [[True, False], [True, True]]
    assert racing_whole(before, actions, after).tolist() == [False, True]


def test_entries_are_those_of_the_environment():
    names = "angle", "trackPos", "speedX", "speedY"
    assert [INDEX[name] for name in names] == [ANGLE, TRACK_POS, SPEED_X, SPEED_Y]
    assert TRACK == OWN_TRACK
    assert UNITS[TRACK].tolist() == [RANGE] * 19
    assert UNITS[[SPEED_X, SPEED_Y]] / 3.6 == pytest.approx([SPEED] * 2)
    assert pytest.approx(DIRECTIONS) == OWN_DIRECTIONS


def test_lateral_speed_and_view():
    # 10 m/s; a negative angle is a car that points to the left of the road
    assert lateral_speed(observe(speed=10, angle=-np.pi / 6)) == pytest.approx([5.0])
    assert lateral_speed(observe(speed=0, sideways=2)) == pytest.approx([2.0])
    metres, direction = free_view(observe(view=50, direction=-30))
    assert (metres[0], direction[0]) == pytest.approx((50.0, -np.pi / 6))


def test_running_wide_is_a_mistake_of_the_steering():
    # 1 m from the left edge at 20·sin 0.1 = 2 m/s: it is there in half a second
    before, after = observe(angle=-0.08, track_pos=0.8, left=1.2), observe(angle=-0.1, track_pos=0.83, left=1.0)
    assert not steering(before, 0.0, after)
    assert not steering(before, -0.4, after)  # to the right, but not half way
    assert steering(before, -0.6, after)
    assert steering(observe(angle=-0.12, track_pos=0.8), 0.0, after)  # lateral speed was taken away
    far = observe(angle=-0.1, track_pos=0.5, left=3.0)
    assert steering(before, 0.0, far)  # one and a half seconds left
    # the same to the right
    assert not steering(observe(angle=0.08, track_pos=-0.8), 0.0, observe(angle=0.1, track_pos=-0.83, right=1.0))


def test_turning_in_against_the_bend_is_a_mistake_of_the_steering():
    before = observe(direction=30, view=40)
    assert not steering(before, -0.2, observe(direction=40, view=40))
    assert steering(before, 0.2, observe(direction=40, view=40))  # towards it
    assert steering(before, -0.05, observe(direction=40, view=40))  # hardly turned
    assert steering(before, -0.2, observe(direction=30, view=40))  # it did not lie further aside
    assert steering(observe(direction=20, view=40), -0.2, observe(direction=30, view=40))  # not much of a bend
    assert steering(observe(direction=30, view=40, sideways=2), -0.2, observe(direction=40, view=40))  # catches a slide
    assert not steering(observe(direction=-30), 0.2, observe(direction=-40))


def test_swinging_past_the_road_is_a_mistake_of_the_steering():
    # from 0.3 rad to 0.08 in a step: another one like it ends at -0.14
    assert not steering(observe(angle=0.3), 0.9, observe(angle=0.08))
    assert not steering(observe(angle=-0.3), -0.9, observe(angle=-0.08))
    assert steering(observe(angle=0.3), 0.9, observe(angle=0.12))  # ends at -0.06
    assert steering(observe(angle=0.3), 0.9, observe(angle=0.16))  # not past it
    assert steering(observe(angle=0.3), 0.1, observe(angle=0.08))  # the wheel was hardly turned
    assert steering(observe(angle=0.3), -0.9, observe(angle=0.08))  # and here it catches the swing


def test_too_fast_for_what_is_in_sight_without_braking_is_a_mistake_of_the_pedal():
    # 12 m/s² stop a car of 30 m/s within 37.5 m
    assert not pedal(observe(speed=31, view=37.5), 0.5, observe(speed=31.5, view=35))
    assert not pedal(observe(speed=31, view=37.5), -0.05, observe(speed=30.8, view=35))  # the engine alone
    assert pedal(observe(speed=31, view=37.5), -0.5, observe(speed=30, view=35))
    assert pedal(observe(speed=29, view=37.5), 0.5, observe(speed=29.5, view=35))


def test_throttle_where_a_bend_carries_the_car_out_is_a_mistake_of_the_pedal():
    # the road goes on to the left; a positive angle is a car that points to the right, at 20·sin 0.1 = 2 m/s
    bend = {"direction": 40, "view": 100, "angle": 0.1}
    assert not pedal(observe(**bend), 0.2, observe())
    assert pedal(observe(**bend), 0.0, observe())
    assert pedal(observe(**bend | {"angle": 0.04}), 0.2, observe())  # 0.8 m/s
    assert pedal(observe(**bend | {"angle": -0.1}), 0.2, observe())  # it moves inward
    assert pedal(observe(**bend | {"direction": 20}), 0.2, observe())  # not much of a bend is left
    assert not pedal(observe(direction=-40, view=100, angle=-0.1), 0.2, observe())


def test_dawdling_is_a_mistake_of_the_pedal():
    # 4 m/s² stop a car of 20 m/s within 50 m
    slow, as_slow = observe(speed=19, view=50), observe(speed=19, view=48)
    assert not pedal(slow, 0.0, as_slow)
    assert pedal(slow, 0.1, as_slow)
    assert pedal(slow, 0.0, observe(speed=19.5, view=48))  # downhill
    assert pedal(observe(speed=21, view=50), 0.0, observe(speed=21, view=48))
    standing = observe(speed=0, view=50)
    assert not pedal(standing, 0.0, standing)
    assert pedal(standing, 0.5, standing)
    across = observe(speed=0, view=50, angle=0.5)
    assert not pedal(across, -0.3, across)
    # badly placed it may be right at speed
    assert pedal(observe(speed=19, view=50, angle=0.5), 0.0, as_slow)
    assert pedal(observe(speed=19, view=50, track_pos=0.9), 0.0, as_slow)


def test_braking_on_an_open_road_is_a_mistake_of_the_pedal():
    # 6 m/s² stop a car of 30 m/s within 75 m
    assert not pedal(observe(speed=29, view=75), -0.1, observe(speed=28, view=72))
    assert pedal(observe(speed=31, view=75), -0.1, observe(speed=30, view=72))
    assert pedal(observe(speed=29, view=75), 0.0, observe(speed=28.9, view=72))
    assert pedal(observe(speed=29, view=75, angle=-0.5), -0.1, observe(speed=28, view=72))


def test_some_pedal_is_permissible_in_every_state():
    rng, pedals = np.random.default_rng(0), np.array([-0.5, 0.0, 0.5])
    for _ in range(2_000):
        before = observe(
            *(rng.uniform(0, 60), rng.uniform(-5, 5), rng.uniform(-0.6, 0.6), rng.uniform(-1, 1), rng.uniform(6, 200)),
            direction=10 * rng.integers(-6, 7),
        )
        after = np.repeat(before, 3, 0)
        after[:, SPEED_X] += pedals / SPEED
        labels = racing(np.repeat(before, 3, 0), np.stack([np.zeros(3), pedals], axis=1), after)
        assert labels[:, 1].any()


def test_parts_are_blamed_apart():
    before, after = observe(19, 0, -0.08, 0.7, 50, left=1.2), observe(18, 0, -0.12, 0.75, 50, left=1.0)
    both = racing(np.repeat(before, 2, 0), np.array([[0.0, -1.0], [-1.0, 1.0]]), np.repeat(after, 2, 0))
    assert both.tolist() == [[False, False], [True, True]]
