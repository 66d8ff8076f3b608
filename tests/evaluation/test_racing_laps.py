"""A recorded lap and its picture."""

import pandas as pd
import pytest

from sb3_sap.envs import get_track
from sb3_sap.evaluation.racing import RaceLap, lap_figure


def steps(metres, seconds):
    """Steps at a constant speed on the centre line, from 100 m before the line of CG Track 3."""
    progress = [metres * i / 10 for i in range(1, 11)]
    return pd.DataFrame(
        {
            "time_s": [seconds * i / 10 for i in range(1, 11)],
            "progress_m": progress,
            "distance_m": [
                (get_track("g-track-3").length - 100 + done) % get_track("g-track-3").length for done in progress
            ],
            "track_pos": 0.0,
            "speed_kmh": metres / seconds * 3.6,
        }
    )


def test_mean_speed_is_that_of_the_part_that_was_driven():
    lap = RaceLap(get_track("g-track-3"), None, 0.25, steps(500.0, 25.0))
    assert lap.mean_speed == pytest.approx(72.0)


def test_figure_describes_every_lap():
    track = get_track("g-track-3")
    whole = RaceLap(track, 90.0, 1.0, steps(track.length, 90.0))
    figure = lap_figure({"trained": RaceLap(track, None, 0.25, steps(500.0, 25.0)), "scripted": whole})
    plan, profile, _ = figure.axes
    assert plan.get_title() == "g-track-3, trained: 25% of the lap"
    assert [text.get_text() for text in profile.get_legend().get_texts()] == [
        "trained: 25% of the lap",
        "scripted: 90.0 s, 114 km/h",
    ]
    figure.draw_without_rendering()
    with pytest.raises(ValueError, match="`laps` is empty"):
        lap_figure({})
