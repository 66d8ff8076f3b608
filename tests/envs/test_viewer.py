"""Pictures of the car on its road, checked by the colours of single pixels."""

import gymnasium as gym
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray

import sb3_sap  # noqa: F401  # registers the environment
from sb3_sap.envs import CarState, get_track
from sb3_sap.envs.tracks import Segment, Track
from sb3_sap.envs.viewer import ACCENT, ASPHALT, CAR, GRASS, LINE, SCALING, SIZE, Viewer
from sb3_sap.evaluation.environments import make_env

MIDDLE = (SIZE[1] // 2, SIZE[0] // 2)
"""Row and column."""


@pytest.fixture(autouse=True)
def _headless(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)


def straight_road() -> Viewer:
    """A long straight to the east, 12 m wide."""
    return Viewer(Track("straight", 12, [Segment.straight(1000), Segment.curve(1.0, 100)]))


def eastward(track_pos: float = 0.0, angle: float = 0.0, steering: float = 0.0) -> NDArray[np.uint8]:
    """A car in the middle of that straight."""
    return straight_road().draw(CarState(angle, track_pos, 50, 0, 0, 500.0), steering)


def at(picture: NDArray[np.uint8], right: float = 0.0, up: float = 0.0) -> tuple[int, ...]:
    """Colour of the pixel that many metres from the middle."""
    return tuple(picture[round(MIDDLE[0] - up * SCALING), round(MIDDLE[1] + right * SCALING)].tolist())


def test_car_road_and_grass_are_in_their_places() -> None:
    picture = eastward()
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    assert picture.dtype == np.uint8
    assert at(picture) == CAR
    assert [at(picture, up=up) for up in (5, -5)] == [ASPHALT, ASPHALT]
    assert [at(picture, up=up) for up in (7, -7)] == [GRASS, GRASS]


def test_car_at_the_left_edge_has_the_road_below_it() -> None:
    picture = eastward(track_pos=1.0)  # the car remains in the middle of the picture; driving east, left is up
    assert at(picture) == CAR
    assert at(picture, up=2) == GRASS
    assert at(picture, up=-11) == ASPHALT


def test_car_that_points_right_of_east_is_drawn_pointing_down() -> None:
    picture = eastward(angle=0.8)  # to the right of east is down
    assert [at(picture, right=1.2, up=up) for up in (-1.2, 1.2)] == [CAR, ASPHALT]


def test_small_headings_are_drawn() -> None:
    assert not np.array_equal(eastward(angle=0.03), eastward())


def test_steering_moves_the_bar_to_its_side() -> None:
    bars = [np.argwhere((eastward(steering=s)[-34:] == ACCENT).all(axis=2))[:, 1] for s in (1.0, -1.0)]
    assert bars[0].max() <= bars[1].min() + 1


def test_only_the_road_nearby_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = Viewer(get_track("spring"))
    drawn: list[float] = []
    position = Track.position

    def spy(track: Track, distance: float, lateral: float = 0.0) -> tuple[float, float, float]:
        drawn.append(distance % track.length)
        return position(track, distance, lateral)

    monkeypatch.setattr(Track, "position", spy)
    viewer.draw(CarState(0, 0, 50, 0, 0, 11_000.0), 0.0)
    assert len(drawn) < 500
    assert 10_900 < min(drawn) < max(drawn) < 11_100


@pytest.mark.parametrize("distance", [0.0, 6205.0])
def test_road_continues_across_the_start_line(distance: float) -> None:
    picture = Viewer(get_track("wheel-2")).draw(CarState(0, 0, 50, 0, 0, distance), 0.0)
    assert [at(picture, right=right, up=3) for right in (-25, 25)] == [ASPHALT, ASPHALT]


def test_environment_renders_another_picture_after_a_step() -> None:
    env = gym.make("sap/LaneKeeping-v0", render_mode="rgb_array")
    env.reset()
    first = env.render()
    env.step(np.array([0.5], dtype=np.float32))
    second = env.render()
    assert isinstance(first, np.ndarray)
    assert first.shape == (SIZE[1], SIZE[0], 3)
    assert not np.array_equal(first, second)
    assert env.metadata["render_fps"] == 5
    env.close()


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[pygame.Window]:
    """Every window that is opened, on a dummy screen."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    opened: list[pygame.Window] = []
    window = pygame.Window
    monkeypatch.setattr(pygame, "Window", lambda *args: opened.append(window(*args)) or opened[-1])
    return opened


def test_window_opens_and_closes(windows: list[pygame.Window]) -> None:
    env = gym.make("sap/LaneKeeping-v0", render_mode="human")
    env.reset()
    env.step(np.zeros(1, dtype=np.float32))
    [window] = windows
    assert window.get_surface().get_at((MIDDLE[1], MIDDLE[0]))[:3] == CAR
    env.close()
    with pytest.raises(pygame.error):
        window.get_surface()


def test_two_windows_do_not_draw_into_each_other(windows: list[pygame.Window]) -> None:
    one, two = (gym.make("sap/LaneKeeping-v0", render_mode="human", track=t) for t in ("wheel-2", "spring"))
    one.reset()
    two.reset()
    titles = [window.title for window in windows]
    assert titles == ["LaneKeeping · wheel-2", "LaneKeeping · spring"]
    two.close()
    one.step(np.zeros(1, dtype=np.float32))
    assert len(windows) == 2
    assert windows[0].get_surface().get_at((MIDDLE[1], MIDDLE[0]))[:3] == CAR
    one.close()


@pytest.mark.parametrize("mode", ["rgb_array", "human"])
@pytest.mark.parametrize("another", ["CartPole-v1", "parking-v0"])
def test_rendering_continues_after_another_environment_quits_pygame(
    windows: list[pygame.Window], mode: str, another: str
) -> None:
    ours, other = gym.make("sap/LaneKeeping-v0", render_mode=mode), make_env(another, render_mode="rgb_array")
    ours.reset()
    other.reset()
    before = ours.render()
    other.render()
    other.close()
    pygame.quit()  # whether or not the other one did
    np.testing.assert_array_equal(before, ours.render())
    pygame.init()  # a font from before cannot be used any more
    np.testing.assert_array_equal(before, ours.render())
    assert len(windows) == (2 if mode == "human" else 0)
    ours.close()


def test_rendering_without_a_mode_warns() -> None:
    env = gym.make("sap/LaneKeeping-v0")
    env.reset()
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.unwrapped.render() is None


# ---------------------------------------------------------------- the fan of steering angles

CENTRED = CarState(0.0, 0.0, 50, 0, 0, 500.0)
LEFT_IS_PERMISSIBLE = np.repeat([0.0, 1.0], 11)
"""The probability for steering from right to left."""


def red_or_green(pixel: NDArray[np.uint8]) -> str:
    red, green, _ = pixel.astype(int)
    return "green" if green > red + 30 else "red" if red > green + 30 else "neither"


def test_fan_is_green_where_steering_is_permissible_and_red_elsewhere() -> None:
    picture = straight_road().draw(CENTRED, 0.0, LEFT_IS_PERMISSIBLE)  # the car drives east: left is up
    (row, column), ahead = MIDDLE, 95  # 95 pixels are 10.6 m
    assert red_or_green(picture[row - 25, column + ahead]) == "green"
    assert red_or_green(picture[row + 25, column + ahead]) == "red"
    assert tuple(picture[row, column + ahead]) == LINE  # the action is to steer straight ahead


def test_fan_leaves_no_trace_in_the_next_picture_without_one() -> None:
    viewer = straight_road()
    fans = (None, LEFT_IS_PERMISSIBLE, None)
    before, with_fan, after = (viewer.draw(CENTRED, 0.0, fan) for fan in fans)
    assert not np.array_equal(with_fan, before)
    assert np.array_equal(after, before)
