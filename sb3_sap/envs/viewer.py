"""Pictures of the car on its track, through highway-env's graphics.

The car is drawn from its `CarState` on the track's plan geometry alone, so any simulator can be looked at. Only the
road near the car is drawn; a small map shows where on the track that is.
"""

from __future__ import annotations

import colorsys
import math
from typing import cast

import numpy as np
import pygame
from highway_env.road.graphics import LaneGraphics, WorldSurface
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.graphics import VehicleGraphics
from numpy.typing import NDArray

from sb3_sap.envs.car import STEERING_LOCK, CarState
from sb3_sap.envs.tracks import Track

#: Width and height of the picture, in pixels.
SIZE = (600, 400)
#: Factor by which the world is drawn larger and then scaled down, for smooth edges.
OVERSAMPLING = 2
#: Pixels per metre of the world.
SCALING = 9.0
#: Distance between two points of the road's edges, m.
ROAD_STEP = 1.0
#: Distance from one dash of the centre line to the next, m; dashes are as long as highway-env's stripes.
DASH_EVERY = 9.0
#: Longest side of the map, in pixels.
MAP_SIZE = 96
#: Distance between two points of the map's line, m.
MAP_STEP = 10.0
#: Margin around the map and the panel's text, in pixels.
MARGIN = 12
#: Height of the panel, in pixels.
PANEL_HEIGHT = 34
#: Distance from the middle of the car to the end of the fan, m.
FAN_RADIUS = 13.0
#: Opacity of the fan, out of 255.
FAN_OPACITY = 150

#: Colours, RGB.
GRASS, ASPHALT, LINE = (112, 150, 84), (138, 140, 145), (245, 245, 240)
CAR, PANEL, ACCENT = (58, 140, 230), (28, 32, 38), (255, 190, 60)


class Viewer:
    """Draw states of the car on one track.

    :param track: its plan geometry
    :param window: show each picture in a window, too
    """

    def __init__(self, track: Track, window: bool = False) -> None:
        self.track = track
        self._lane = _UnrolledTrack(track)
        self._font: pygame.font.Font | None = None
        world_size = (SIZE[0] * OVERSAMPLING, SIZE[1] * OVERSAMPLING)
        self._world = WorldSurface(world_size, 0, pygame.Surface(world_size))
        self._world.scaling = SCALING * OVERSAMPLING
        self._picture = pygame.Surface(SIZE)
        self._map = _Map(track)
        self._shown = window
        self._window: pygame.Window | None = None

    def draw(self, state: CarState, steering: float, fan: NDArray[np.floating] | None = None) -> NDArray[np.uint8]:
        """Return the picture of a state, shape (height, width, 3), north up and the car in the middle.

        :param steering: the last action, in [-1, 1], positive to the left
        :param fan: drawn before the car, if given: for steering from -1 to 1, in equal steps, the probability that it
            is permissible, shape (n,); green where it is, red where it is not
        """
        x, y, road_heading = self.track.position(state.distance, state.track_pos * self.track.width / 2)
        self._world.move_display_window_to(np.array([x, y]))
        self._draw_road(state.distance)
        if fan is not None:
            self._draw_fan(x, y, road_heading - state.angle, steering, fan)
        self._draw_car(x, y, road_heading - state.angle, steering)
        upright = pygame.transform.flip(self._world, False, True)  # pixels count downwards, the plan's y upwards
        pygame.transform.smoothscale(upright, SIZE, self._picture)
        self._map.draw(self._picture, state.distance)
        self._draw_panel(state, steering)
        if self._shown:
            self._show()
        return np.ascontiguousarray(pygame.surfarray.array3d(self._picture).swapaxes(0, 1))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.destroy()
            self._window = None

    def _show(self) -> None:
        # A window of its own, because pygame has only one display. Another environment may quit pygame at any time.
        try:
            surface = None if self._window is None else self._window.get_surface()
        except pygame.error:
            surface = None
        if surface is None:
            pygame.display.init()
            self._window = pygame.Window(f"LaneKeeping · {self.track.name}", SIZE)
            surface = self._window.get_surface()
        pygame.event.pump()
        surface.blit(self._picture, (0, 0))
        cast(pygame.Window, self._window).flip()

    def _text(self, text: str) -> pygame.Surface:
        try:
            font = self._font or pygame.font.Font(None, 22)
            drawn = font.render(text, True, LINE)
        except pygame.error:  # never initialised, or quit by another environment since
            pygame.font.init()
            font = pygame.font.Font(None, 22)
            drawn = font.render(text, True, LINE)
        self._font = font
        return drawn

    def _draw_road(self, distance: float) -> None:
        reach = math.hypot(*SIZE) / SCALING / 2 + self.track.width
        here = distance + self.track.length * math.ceil(reach / self.track.length)  # stripes must not begin below 0
        along = np.arange(here - reach, here + reach, ROAD_STEP)
        half = self.track.width / 2
        left, right = ([self._world.vec2pix(self._lane.position(s, side)) for s in along] for side in (half, -half))
        self._world.fill(GRASS)
        pygame.draw.polygon(self._world, ASPHALT, left + right[::-1])
        for edge in (left, right):
            pygame.draw.lines(self._world, LINE, False, edge, self._world.pix(LaneGraphics.STRIPE_WIDTH))
        dashes = np.arange((here - reach) // DASH_EVERY, (here + reach) // DASH_EVERY) * DASH_EVERY
        ends = dashes + LaneGraphics.STRIPE_LENGTH
        LaneGraphics.draw_stripes(self._lane, self._world, dashes, ends, np.zeros_like(dashes))
        if distance < reach or self.track.length - distance < reach:  # the start line
            start = [self._world.vec2pix(self._lane.position(0.0, side)) for side in (half, -half)]
            pygame.draw.lines(self._world, LINE, False, start, self._world.pix(2 * LaneGraphics.STRIPE_WIDTH))

    def _draw_car(self, x: float, y: float, heading: float, steering: float) -> None:
        # highway-env draws headings of less than 2 degrees as none: a whole turn more avoids that.
        car = BicycleVehicle(None, (x, y), heading % math.tau + math.tau)
        car.color = CAR
        car.act({"steering": steering * STEERING_LOCK, "acceleration": 0.0})
        VehicleGraphics.display(car, self._world, offscreen=True)

    def _draw_fan(self, x: float, y: float, heading: float, steering: float, fan: NDArray[np.floating]) -> None:
        def end(action: float) -> tuple[int, int]:
            """The pixel at which the front wheels point, turned by an action."""
            angle = heading + action * STEERING_LOCK
            point: tuple[int, int] = self._world.vec2pix(
                (x + FAN_RADIUS * math.cos(angle), y + FAN_RADIUS * math.sin(angle))
            )
            return point

        car = self._world.vec2pix((x, y))
        layer = pygame.Surface(self._world.get_size(), pygame.SRCALPHA)
        half = 1 / max(len(fan) - 1, 1)
        for action, probability in zip(np.linspace(-1, 1, len(fan)), fan, strict=True):
            hue = float(probability) / 3  # a third of the colour wheel, from red to green
            colour = [round(255 * part) for part in colorsys.hsv_to_rgb(hue, 0.85, 0.9)]
            pygame.draw.polygon(layer, (*colour, FAN_OPACITY), [car, end(action - half), end(action + half)])
        pygame.draw.line(layer, LINE, car, end(steering), 3 * OVERSAMPLING)
        self._world.blit(layer, (0, 0))

    def _draw_panel(self, state: CarState, steering: float) -> None:
        top = SIZE[1] - PANEL_HEIGHT
        pygame.draw.rect(self._picture, PANEL, (0, top, SIZE[0], PANEL_HEIGHT))
        text = (
            f"{state.speed_x:3.0f} km/h     trackPos {state.track_pos:+.2f}     angle {math.degrees(state.angle):+.1f}°"
            f"     {state.distance:,.0f} m"
        )
        self._picture.blit(self._text(text), (MARGIN, top + 10))
        # A bar from the middle of its rail shows the steering, to the left where it steers left.
        middle, length, height = SIZE[0] - MARGIN - 60, 60, top + PANEL_HEIGHT // 2
        pygame.draw.line(self._picture, ASPHALT, (middle - length, height), (middle + length, height), 8)
        pygame.draw.line(self._picture, ACCENT, (middle, height), (middle - round(steering * length), height), 8)
        pygame.draw.line(self._picture, LINE, (middle, height - 8), (middle, height + 8), 2)


class _UnrolledTrack(AbstractLane):  # type: ignore[misc]
    """The whole track as one of highway-env's lanes, lap after lap, for its stripes."""

    length = math.inf

    def __init__(self, track: Track) -> None:
        self.track = track

    def position(self, longitudinal: float, lateral: float) -> NDArray[np.float64]:
        return np.array(self.track.position(longitudinal, lateral)[:2])


class _Map:
    """The plan of the whole track in the corner of the picture, with a dot where the car is."""

    def __init__(self, track: Track) -> None:
        self.track = track
        points = np.array([track.position(s)[:2] for s in np.arange(0.0, track.length, MAP_STEP)])
        self._corner = points.min(axis=0)
        extent = points.max(axis=0) - self._corner
        self._scale = MAP_SIZE / extent.max()
        self._size = extent * self._scale
        self._points = [self._pixel(point) for point in points]

    def draw(self, picture: pygame.Surface, distance: float) -> None:
        width, height = self._size + 2 * MARGIN
        shade = pygame.Surface((width, height), pygame.SRCALPHA)
        shade.fill((*PANEL, 200))
        pygame.draw.aalines(shade, LINE, True, self._points)
        pygame.draw.circle(shade, ACCENT, self._pixel(np.array(self.track.position(distance)[:2])), 4)
        picture.blit(shade, (SIZE[0] - width, 0))

    def _pixel(self, point: NDArray[np.float64]) -> tuple[float, float]:
        x, y = (point - self._corner) * self._scale
        return float(x) + MARGIN, float(self._size[1] - y) + MARGIN
