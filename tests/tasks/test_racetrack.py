"""The AP function of highway-env's racetrack, on transitions computed by hand."""

import numpy as np
import pytest

from sb3_sap.tasks import racetrack
from sb3_sap.tasks.racetrack import car_near, course


def seen(offset, angle=0.0, other=None):
    """What a car sees at an offset, m, and an angle, rad, from its lane, with another car at (x, y) m from it."""
    obs = np.zeros((1, 2, 7), dtype=np.float32)
    obs[0, 0] = 1, 0.5, 0.2, 1, 0, offset, angle
    if other is not None:
        obs[0, 1, :3] = 1, other[0] / 100, other[1] / 100
    return obs


def test_course_is_the_offset_five_metres_on():
    assert course(seen(1.0)) == pytest.approx([1.0])
    assert course(seen(1.0, -np.arcsin(0.4))) == pytest.approx([-1.0])


@pytest.mark.parametrize(
    ("before", "after", "permissible"),
    [
        ((1.0, 0.0), (1.0, 0.1), False),  # turned away from the middle
        ((1.0, 0.1), (1.0, 0.0), True),  # and back
        ((1.0, -0.2), (0.8, 0.0), False),  # its course led to the middle, and leads beside it
        ((0.2, 0.0), (0.2, 0.05), True),  # half a metre is no mistake
        ((1.0, -0.2), (0.9, -0.5), False),  # over the middle to the other side
        ((2.4, 0.2), (-2.5, 0.2), True),  # from here on it is the next lane
    ],
)
def test_turning_away_from_the_lane_is_a_mistake(before, after, permissible):
    assert racetrack(seen(*before), np.zeros((1, 1)), seen(*after)).tolist() == [permissible]
    mirrored = [seen(-offset, -angle) for offset, angle in (before, after)]
    assert racetrack(mirrored[0], np.zeros((1, 1)), mirrored[1]).tolist() == [permissible]


def test_nothing_is_judged_near_another_car():
    assert car_near(seen(0.0, other=(15, 15))).tolist() == [True]
    assert car_near(seen(0.0, other=(20, 20))).tolist() == [False]
    assert car_near(seen(0.0)).tolist() == [False]
    far, near = ({"other": place} for place in ((40, 0), (20, 0)))
    assert racetrack(seen(1, 0, **far), np.zeros((1, 1)), seen(1, 0.1, **far)).tolist() == [False]
    assert racetrack(seen(1, 0, **far), np.zeros((1, 1)), seen(1, 0.1, **near)).tolist() == [True]
