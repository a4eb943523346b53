"""Common parts of pictures of plants: colours, a smoothed canvas, arcs, arrows and text."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.errors import ParameterError

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

__all__ = ["BACKGROUND", "BOB", "DISTURBANCE", "GREY", "INK", "LINK", "OVERSAMPLING", "TORQUE", "Colour", "Picture"]

Colour = tuple[int, int, int]
"""Red, green and blue."""
BACKGROUND = (250, 250, 248)
INK = (40, 44, 52)
GREY = (190, 192, 196)
LINK = (92, 104, 122)
BOB = (208, 84, 58)
TORQUE = (38, 120, 178)
DISTURBANCE = (222, 140, 20)
OVERSAMPLING = 2
"""Canvas size relative to the picture: smoothing removes pygame's ragged edges."""
_MIN_SIZE, _MAX_SIZE = 120, 4096


class Picture:
    """A canvas of a size, 120 to 4096 [px] or a ParameterError, and the parts of a plant's picture.

    ``trail`` is its number of positions; ``lines`` of text fill the height; ``canvas`` is ``OVERSAMPLING`` times as
    large as the picture, ``surface``.
    """

    def __init__(self, size: tuple[int, int], *, trail: int, lines: int = 20) -> None:
        import pygame

        if len(size) != 2 or not all(_MIN_SIZE <= int(side) <= _MAX_SIZE for side in size):
            raise ParameterError(f"screen size is {size} px; expected two numbers from {_MIN_SIZE} to {_MAX_SIZE}")
        self.size = (int(size[0]), int(size[1]))
        self.pygame = pygame
        pygame.font.init()
        self.canvas = pygame.Surface((self.size[0] * OVERSAMPLING, self.size[1] * OVERSAMPLING))
        self.surface = pygame.Surface(self.size)
        self._trail: deque[Any] = deque(maxlen=trail)
        self._font = pygame.font.Font(None, max(400 // lines, min(self.size) // lines) * OVERSAMPLING)

    def array(self) -> NDArray[np.uint8]:
        """Return red, green and blue, shape (height, width, 3)."""
        pixels: NDArray[np.uint8] = self.pygame.surfarray.array3d(self.surface)
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def clear_trail(self) -> None:
        """Clear the trail."""
        self._trail.clear()

    def show_text(self, note: str) -> None:
        """Draw a line of text alone."""
        self.canvas.fill(BACKGROUND)
        self.draw_text([], note)
        self.finish()

    # --- parts ---------------------------------------------------------------------------------------------

    def finish(self) -> None:
        """Make the picture from the canvas."""
        self.pygame.transform.smoothscale(self.canvas, self.size, self.surface)

    def draw_text(self, rows: Sequence[tuple[str, Colour]], note: str) -> None:
        """Draw coloured lines at the top, and one at the bottom."""
        margin = 10 * OVERSAMPLING
        for row, (text, colour) in enumerate(rows):
            image = self._font.render(text, True, colour)
            self.canvas.blit(image, (margin, margin + row * self._font.get_linesize()))
        if note:
            image = self._font.render(note, True, INK)
            self.canvas.blit(image, (margin, self.canvas.get_height() - margin - image.get_height()))

    def draw_dial(self, origin: Any, length: float) -> None:
        """Draw a mark every 15 degrees around a point, beyond a length."""
        for degrees in range(0, 360, 15):
            long = degrees % 90 == 0
            turn = math.radians(degrees)
            way = np.array([math.sin(turn), math.cos(turn)])
            ends = origin + 1.13 * length * way, origin + (1.21 if long else 1.17) * length * way
            self.pygame.draw.line(self.canvas, INK if long else GREY, *ends, (3 if long else 2) * OVERSAMPLING // 2)

    def draw_trail(self, points: Sequence[Any], size: float) -> None:
        """Draw the tip's path, oldest first, paler and smaller with age."""
        for age, point in enumerate(points):
            share = (age + 1) / len(points) * 0.35
            colour = [round(b + (t - b) * share) for b, t in zip(BACKGROUND, BOB, strict=True)]
            self.pygame.draw.circle(self.canvas, colour, point, size * (0.4 + share))

    def draw_arc(self, origin: Any, right: Any, up: Any, share: float, length: float) -> None:
        """Draw a torque as an arc with a head.

        ``right`` and ``up`` lead from the origin to the arc's start and to a quarter turn [px]; ``share`` is the torque
        relative to that of a full arc; ``length`` is the plant's size [px].
        """
        share = max(-1.0, min(1.0, share))
        # A square root shows the small torques of regulation next to the full one.
        sweep = math.copysign(math.sqrt(abs(share)), share) * 1.5 * math.pi / 2.0
        if abs(sweep) < 0.02:
            return
        right, up = np.asarray(right), np.asarray(up)
        points = [origin + math.cos(angle) * right + math.sin(angle) * up for angle in np.linspace(0.0, sweep, 40)]
        thick = max(2, round(0.022 * length))
        for a, b in pairwise(points):
            self.pygame.draw.line(self.canvas, TORQUE, a, b, thick)
            self.pygame.draw.circle(self.canvas, TORQUE, b, thick / 2)
        direction = (math.cos(sweep) * up - math.sin(sweep) * right) * math.copysign(1.0, sweep)
        self.draw_head(points[-1], direction, 0.07 * length, TORQUE)

    def draw_force(self, begin: Any, along: Any, share: float, length: float) -> None:
        """Draw a slide's force as an arrow, with the scale of :meth:`draw_arc`."""
        share = math.copysign(math.sqrt(min(1.0, abs(share))), share)
        if abs(share) > 0.02:
            self.draw_arrow(begin, along, share, length, TORQUE, shortest=0.0)

    def draw_arrow(
        self,
        begin: Any,
        along: Any,
        share: float,
        length: float,
        colour: Colour = DISTURBANCE,
        *,
        shortest: float = 0.15,
    ) -> None:
        """Draw a torque or a force as an arrow from ``begin`` in the direction ``along`` [px].

        ``share`` is relative to that shown by half of ``length``, the plant's size [px]; ``shortest`` is the share of
        ``length`` of the smallest arrow.
        """
        size = float(np.hypot(*along))
        if not share or size == 0.0:
            return
        way = np.asarray(along) / size * math.copysign(1.0, share)
        tip = begin + way * (0.12 + shortest + 0.35 * min(1.0, abs(share))) * length
        self.pygame.draw.line(self.canvas, colour, begin + way * 0.12 * length, tip, max(2, round(0.02 * length)))
        self.draw_head(tip, way, 0.07 * length, colour)

    def draw_head(self, at: Any, direction: Any, size: float, colour: Colour) -> None:
        """Draw the head of an arrow."""
        reach = float(np.hypot(*direction))
        if reach == 0.0:
            return
        along = np.asarray(direction) / reach
        across = np.array([-along[1], along[0]])
        corners = [at + size * along, at + 0.6 * size * across, at - 0.6 * size * across]
        self.pygame.draw.polygon(self.canvas, colour, corners)
