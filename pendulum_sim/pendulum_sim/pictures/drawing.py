"""Pictures of the pendulum: one drawing for the environment, the viewer and saved files.

Screen coordinates come from the rotation matrix::

    p = origin + s R(theta) p_link,    R = [[cos, -sin], [sin, cos]]

with the link hanging along -y in its own frame, and the screen's y axis pointing down.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.whole_file import writing
from pendulum_sim.pictures.canvas import BACKGROUND, BOB, DISTURBANCE, INK, LINK, TORQUE, Picture

__all__ = ["PendulumPicture", "Window", "rotation_matrix", "save_gif", "save_png"]


def rotation_matrix(theta: float) -> NDArray[np.float64]:
    """Return R(theta), which turns a vector counter-clockwise, shape (2, 2).

    Args:
        theta: Angle [rad].
    """
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, -sin], [sin, cos]])


class PendulumPicture(Picture):
    """Draws a pendulum with its torque, disturbance, trail and numbers.

    Args:
        size: Width and height [px].
        effort_limit: Torque at which the arc is full [N m].
        trail: Positions that the trail remembers.

    Raises:
        ParameterError: The size is outside 120 to 4096 px.
    """

    def __init__(self, size: tuple[int, int], effort_limit: float, *, trail: int = 60) -> None:
        super().__init__(size, trail=trail)
        self._limit = effort_limit

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
        canvas = self.canvas
        canvas.fill(BACKGROUND)
        width, height = canvas.get_size()
        origin = np.array([0.5 * width, 0.52 * height])
        length = 0.36 * min(width, height)
        self._trail.append(theta)
        self.draw_dial(origin, length)
        bob = np.array([[0.0, -length]])
        self.draw_trail([self._to_screen(bob, each, origin)[0] for each in self._trail], 0.045 * length)
        self._draw_link(origin, length, theta)
        radius = 0.27 * length
        self.draw_arc(origin, (radius, 0.0), (0.0, -radius), effort / self._limit, length)
        if disturbance:
            along = np.array([math.cos(theta), -math.sin(theta)])
            self.draw_arrow(self._to_screen(bob, theta, origin)[0], along, disturbance / self._limit, length)
        self._draw_numbers(theta, theta_dot, effort, disturbance, time, note)
        self.finish()

    # --- parts ---------------------------------------------------------------------------------------------

    def _to_screen(self, points: NDArray[np.float64], theta: float, origin: Any) -> NDArray[np.float64]:
        turned = points @ rotation_matrix(theta).T
        return origin + turned * np.array([1.0, -1.0])

    def _draw_link(self, origin: Any, length: float, theta: float) -> None:
        draw = self.pygame.draw
        half = 0.028 * length
        outline = np.array([[-half, 0.0], [half, 0.0], [half, -length], [-half, -length]])
        draw.polygon(self.canvas, LINK, self._to_screen(outline, theta, origin))
        draw.circle(self.canvas, BOB, self._to_screen(np.array([[0.0, -length]]), theta, origin)[0], 0.1 * length)
        draw.circle(self.canvas, INK, origin, 0.055 * length)
        draw.circle(self.canvas, BACKGROUND, origin, 0.022 * length)

    def _draw_numbers(
        self, theta: float, theta_dot: float, effort: float, disturbance: float, time: float | None, note: str
    ) -> None:
        deviation = from_upright(theta)
        rows = [
            (f"theta {theta:+.4f} rad", INK),
            (f"from upright {deviation:+.4f} rad", INK),
            (f"theta' {theta_dot:+.3f} rad/s", INK),
            (f"torque {effort:+.3f} N m", TORQUE),
        ]
        if disturbance:
            rows.append((f"disturbance {disturbance:+.3f} N m", DISTURBANCE))
        if time is not None:
            rows.insert(0, (f"{time:.3f} s", INK))
        self.draw_text(rows, note)


_EXPECTED = "expected a display (ssh -X, or window:=false with png or gif)"
_INVISIBLE = ("dummy", "offscreen", "evdev", "kmsdrm")


class Window:
    """A window on the screen that shows pictures.

    Args:
        size: Width and height of the pictures [px].
        title: Title of the window.

    Raises:
        ParameterError: There is no display.
    """

    def __init__(self, size: tuple[int, int], title: str = "pendulum") -> None:
        import pygame

        self.closed = False
        self._pygame = pygame
        chosen = os.environ.get("SDL_VIDEODRIVER", "")
        if sys.platform == "linux" and not (chosen or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))):
            raise ParameterError(f"DISPLAY and WAYLAND_DISPLAY are not set, so there is no window; {_EXPECTED}")
        try:
            pygame.display.init()
            # SDL falls back to drivers that show nothing.
            if (driver := pygame.display.get_driver()) in _INVISIBLE and driver != chosen:
                pygame.display.quit()
                raise ParameterError(f"no window can be opened, {driver} shows none; {_EXPECTED}")
            self._screen = pygame.display.set_mode(size)
        except pygame.error as error:
            raise ParameterError(f"no window can be opened: {error}; {_EXPECTED}") from error
        pygame.display.set_caption(title)
        self._clock = pygame.time.Clock()

    def show(self, picture: Picture, *, fps: int = 0) -> None:
        """Put a picture on the screen.

        Args:
            picture: What to show.
            fps: Wait so that there are at most this many pictures per second; 0 for no wait.
        """
        self._screen.blit(picture.surface, (0, 0))
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
    with writing(f"picture {path}", ParameterError):
        path.parent.mkdir(parents=True, exist_ok=True)
        images[0].save(path, kind, **options)
    return path
