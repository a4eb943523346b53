"""Pictures of the pendulum: one drawing for the environment, the viewer and saved files.

Screen coordinates come from the rotation matrix::

    p = origin + s R(theta) p_link,    R = [[cos, -sin], [sin, cos]]

with the link hanging along -y in its own frame, and the screen's y axis pointing down.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.errors import ParameterError

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

__all__ = ["PendulumPicture", "Window", "rotation_matrix", "save_gif", "save_png"]

_BACKGROUND = (250, 250, 248)
_INK = (40, 44, 52)
_GREY = (190, 192, 196)
_LINK = (92, 104, 122)
_BOB = (208, 84, 58)
_TORQUE = (38, 120, 178)
_DISTURBANCE = (222, 140, 20)
_TRAIL = (208, 84, 58)
_MIN_SIZE, _MAX_SIZE = 120, 4096
_OVERSAMPLING = 2
"""Drawn twice as large and smoothed down: pygame's shapes have ragged edges."""


def rotation_matrix(theta: float) -> NDArray[np.float64]:
    """Return R(theta), which turns a vector counter-clockwise, shape (2, 2).

    Args:
        theta: Angle [rad].
    """
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, -sin], [sin, cos]])


class PendulumPicture:
    """Draws a pendulum with its torque, disturbance, trail and numbers.

    Args:
        size: Width and height [px].
        effort_limit: Torque at which the arc is full [N m].
        trail: Positions that the trail remembers.

    Raises:
        ParameterError: The size is outside 120 to 4096 px.
    """

    def __init__(self, size: tuple[int, int], effort_limit: float, *, trail: int = 60) -> None:
        import pygame

        if len(size) != 2 or not all(_MIN_SIZE <= int(side) <= _MAX_SIZE for side in size):
            raise ParameterError(f"screen size is {size} px; expected two numbers from {_MIN_SIZE} to {_MAX_SIZE}")
        self.size = (int(size[0]), int(size[1]))
        self._pygame = pygame
        pygame.font.init()
        self._limit = effort_limit
        self._trail: deque[float] = deque(maxlen=trail)
        self._scale = _OVERSAMPLING
        self._canvas = pygame.Surface((self.size[0] * self._scale, self.size[1] * self._scale))
        self.surface = pygame.Surface(self.size)
        self._font = pygame.font.Font(None, max(20, min(self.size) // 20) * self._scale)

    def draw(
        self,
        theta: float,
        theta_dot: float,
        effort: float,
        *,
        disturbance: float = 0.0,
        time: float | None = None,
        note: str = "",
    ) -> None:
        """Draw one state.

        Args:
            theta: Angle, 0 hanging [rad].
            theta_dot: Velocity [rad/s].
            effort: Torque, drawn as an arc [N m].
            disturbance: Disturbance torque, drawn as an arrow at the bob [N m].
            time: Time to write [s]; None for none.
            note: A line of text.
        """
        canvas = self._canvas
        canvas.fill(_BACKGROUND)
        width, height = canvas.get_size()
        origin = np.array([0.5 * width, 0.52 * height])
        length = 0.36 * min(width, height)
        self._trail.append(theta)
        self._draw_scale(origin, length)
        self._draw_trail(origin, length)
        self._draw_link(origin, length, theta)
        self._draw_torque(origin, length, effort)
        if disturbance:
            self._draw_disturbance(origin, length, theta, disturbance)
        self._draw_numbers(theta, theta_dot, effort, disturbance, time, note)
        self._pygame.transform.smoothscale(canvas, self.size, self.surface)

    def array(self) -> NDArray[np.uint8]:
        """Return the picture as red, green and blue, shape (height, width, 3)."""
        pixels: NDArray[np.uint8] = self._pygame.surfarray.array3d(self.surface)
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def clear_trail(self) -> None:
        """Forget where the bob has been."""
        self._trail.clear()

    # --- parts ---------------------------------------------------------------------------------------------

    def _to_screen(self, points: NDArray[np.float64], theta: float, origin: Any) -> NDArray[np.float64]:
        turned = points @ rotation_matrix(theta).T
        return origin + turned * np.array([1.0, -1.0])

    def _draw_scale(self, origin: Any, length: float) -> None:
        line = self._pygame.draw.line
        for degrees in range(0, 360, 15):
            long = degrees % 90 == 0
            ends = np.array([[0.0, -1.13 * length], [0.0, -(1.17 if not long else 1.21) * length]])
            a, b = self._to_screen(ends, math.radians(degrees), origin)
            line(self._canvas, _INK if long else _GREY, a, b, (3 if long else 2) * self._scale // 2)

    def _draw_trail(self, origin: Any, length: float) -> None:
        count = len(self._trail)
        bob = np.array([[0.0, -length]])
        for age, theta in enumerate(self._trail):
            share = (age + 1) / count * 0.35
            colour = [round(b + (t - b) * share) for b, t in zip(_BACKGROUND, _TRAIL, strict=True)]
            self._pygame.draw.circle(
                self._canvas, colour, self._to_screen(bob, theta, origin)[0], 0.045 * length * (0.4 + share)
            )

    def _draw_link(self, origin: Any, length: float, theta: float) -> None:
        draw = self._pygame.draw
        half = 0.028 * length
        outline = np.array([[-half, 0.0], [half, 0.0], [half, -length], [-half, -length]])
        draw.polygon(self._canvas, _LINK, self._to_screen(outline, theta, origin))
        draw.circle(self._canvas, _BOB, self._to_screen(np.array([[0.0, -length]]), theta, origin)[0], 0.1 * length)
        draw.circle(self._canvas, _INK, origin, 0.055 * length)
        draw.circle(self._canvas, _BACKGROUND, origin, 0.022 * length)

    def _draw_torque(self, origin: Any, length: float, effort: float) -> None:
        share = max(-1.0, min(1.0, effort / self._limit))
        # A square root shows the small torques of regulation beside the full one.
        sweep = math.copysign(math.sqrt(abs(share)), share) * 1.5 * math.pi / 2.0
        if abs(sweep) < 0.02:
            return
        radius = 0.27 * length
        angles = np.linspace(0.0, sweep, 40)
        points = origin + radius * np.stack([np.cos(angles), -np.sin(angles)], axis=1)
        thick = max(2, round(0.022 * length))
        for a, b in pairwise(points):
            self._pygame.draw.line(self._canvas, _TORQUE, a, b, thick)
            self._pygame.draw.circle(self._canvas, _TORQUE, b, thick / 2)
        direction = np.array([-math.sin(sweep), -math.cos(sweep)]) * math.copysign(1.0, sweep)
        self._draw_head(points[-1], direction, 0.07 * length, _TORQUE)

    def _draw_disturbance(self, origin: Any, length: float, theta: float, disturbance: float) -> None:
        bob = self._to_screen(np.array([[0.0, -length]]), theta, origin)[0]
        along = np.array([math.cos(theta), -math.sin(theta)]) * math.copysign(1.0, disturbance)
        size = (0.15 + 0.35 * min(1.0, abs(disturbance) / self._limit)) * length
        tip = bob + along * (0.12 * length + size)
        self._pygame.draw.line(
            self._canvas, _DISTURBANCE, bob + along * 0.12 * length, tip, max(2, round(0.02 * length))
        )
        self._draw_head(tip, along, 0.07 * length, _DISTURBANCE)

    def _draw_head(self, at: Any, direction: Any, size: float, colour: tuple[int, int, int]) -> None:
        across = np.array([-direction[1], direction[0]])
        corners = [at + size * direction, at + 0.6 * size * across, at - 0.6 * size * across]
        self._pygame.draw.polygon(self._canvas, colour, corners)

    def _draw_numbers(
        self, theta: float, theta_dot: float, effort: float, disturbance: float, time: float | None, note: str
    ) -> None:
        deviation = from_upright(theta)
        rows = [
            (f"theta {theta:+.4f} rad", _INK),
            (f"from upright {deviation:+.4f} rad", _INK),
            (f"theta' {theta_dot:+.3f} rad/s", _INK),
            (f"torque {effort:+.3f} N m", _TORQUE),
        ]
        if disturbance:
            rows.append((f"disturbance {disturbance:+.3f} N m", _DISTURBANCE))
        if time is not None:
            rows.insert(0, (f"{time:.3f} s", _INK))
        margin = 10 * self._scale
        for row, (text, colour) in enumerate(rows):
            image = self._font.render(text, True, colour)
            self._canvas.blit(image, (margin, margin + row * self._font.get_linesize()))
        if note:
            image = self._font.render(note, True, _INK)
            self._canvas.blit(image, (margin, self._canvas.get_height() - margin - image.get_height()))


class Window:
    """A window on the screen that shows a picture.

    Args:
        picture: What to show.
        title: Title of the window.

    Raises:
        ParameterError: There is no display.
    """

    def __init__(self, picture: PendulumPicture, title: str = "pendulum") -> None:
        import pygame

        self.picture = picture
        self.closed = False
        self._pygame = pygame
        try:
            pygame.display.init()
            self._screen = pygame.display.set_mode(picture.size)
        except pygame.error as error:
            raise ParameterError(f"no window can be opened: {error}; expected a display") from error
        pygame.display.set_caption(title)
        self._clock = pygame.time.Clock()

    def show(
        self,
        theta: float,
        theta_dot: float,
        effort: float,
        *,
        disturbance: float = 0.0,
        time: float | None = None,
        note: str = "",
        fps: int = 0,
    ) -> None:
        """Draw a state and put it on the screen.

        Args:
            theta: Angle [rad].
            theta_dot: Velocity [rad/s].
            effort: Torque [N m].
            disturbance: Disturbance torque [N m].
            time: Time to write [s].
            note: A line of text.
            fps: Wait so that there are at most this many pictures per second; 0 for no wait.
        """
        self.picture.draw(theta, theta_dot, effort, disturbance=disturbance, time=time, note=note)
        self._screen.blit(self.picture.surface, (0, 0))
        self._pygame.display.flip()
        if fps:
            self._clock.tick(fps)
        for event in self._pygame.event.get():
            if event.type == self._pygame.QUIT:
                self.closed = True

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()


def save_png(path: str | Path, picture: NDArray[np.uint8]) -> Path:
    """Write a picture of shape (height, width, 3) as PNG.

    Raises:
        ParameterError: The file cannot be written.
    """
    return _save(path, [picture], "PNG")


def save_gif(path: str | Path, pictures: Sequence[NDArray[np.uint8]], fps: float) -> Path:
    """Write an animation as GIF.

    Args:
        path: Where to write.
        pictures: At least one, each of shape (height, width, 3).
        fps: Pictures per second.

    Raises:
        ParameterError: There is no picture, or the file cannot be written.
    """
    if not pictures:
        raise ParameterError("an animation of 0 pictures; expected at least one")
    return _save(path, pictures, "GIF", duration=max(20, round(1000.0 / fps)), loop=0, append=True)


def _save(
    path: str | Path, pictures: Sequence[NDArray[np.uint8]], kind: str, append: bool = False, **options: Any
) -> Path:
    # Pillow comes with matplotlib.
    from PIL import Image

    path = Path(path)
    images = [Image.fromarray(picture) for picture in pictures]
    if append:
        palette = [image.quantize(colors=64, dither=Image.Dither.NONE) for image in images]
        images, options["append_images"], options["save_all"] = palette[:1], palette[1:], True
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        images[0].save(path, kind, **options)
    except OSError as error:
        raise ParameterError(f"{path} cannot be written: {error.strerror or error}") from error
    return path
