"""Pictures of plants of several joints, from the points of their chain: one drawing for environments and pages."""

from __future__ import annotations

import math
import os
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.mechanisms.mechanism import Mechanism, Point
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

__all__ = ["MechanismPicture", "seen_from_the_side"]

_BACKGROUND = (250, 250, 248)
_INK = (40, 44, 52)
_GREY = (190, 192, 196)
_LINKS = ((92, 104, 122), (208, 84, 58))
_OVERSAMPLING = 2
_TILT = math.radians(25.0)
"""From how far above a plant in space is looked at."""


class MechanismPicture:
    """Draws a plant from the side, or in space from a little above, with a driven joint filled and a passive one open.

    Args:
        parameters: The plant.
        size: Width and height [px].

    Raises:
        ParameterError: The size is too small or too large to draw.
    """

    def __init__(self, parameters: MechanismParameters, size: tuple[int, int] = (600, 600)) -> None:
        if not all(120 <= side <= 4096 for side in size):
            raise ParameterError(f"screen_size is {size}; expected 120 to 4096 px each")
        import pygame

        pygame.font.init()
        self._pygame = pygame
        self._parameters = parameters
        self._size = size
        self._surface = pygame.Surface([_OVERSAMPLING * side for side in size])
        self._font = pygame.font.Font(None, _OVERSAMPLING * max(16, min(size) // 24))
        still = (0.0,) * len(parameters.joints)
        points = parameters.mechanism.chain(still, parameters.packed)
        reach = sum(math.dist(first, second) for first, second in pairwise(points))
        own = [joint for joint in parameters.joints if joint.upper_stop is not None and joint.lower_stop is not None]
        self._track = max(
            (max(abs(joint.lower_stop or 0.0), abs(joint.upper_stop or 0.0)) for joint in own), default=0.0
        )
        self._scale = 0.45 * min(self._surface.get_size()) / max(1.1 * reach, self._track)

    def draw(self, position: Vector, *, time: float | None = None) -> None:
        """Draw the plant at a position.

        Args:
            position: n positions [rad or m].
            time: Time that is written beside it [s]; None for none.
        """
        pygame, surface = self._pygame, self._surface
        surface.fill(_BACKGROUND)
        mechanism = self._parameters.mechanism
        width = max(4, min(surface.get_size()) // 60)
        if mechanism.joints[0].unit == "m":
            reach = self._track or 10.0
            ends = [self._pixel((side * reach, 0.0, 0.0)) for side in (-1.0, 1.0)]
            pygame.draw.line(surface, _GREY, *ends, width // 3)
            for end in ends if self._track else []:
                pygame.draw.line(surface, _GREY, (end[0], end[1] - 2 * width), (end[0], end[1] + 2 * width), width // 2)
        points = [self._pixel(point) for point in mechanism.chain(position, self._parameters.packed)]
        if mechanism.joints[0].unit == "m":
            cart = pygame.Rect(0, 0, 6 * width, 3 * width)
            cart.center = points[0]
            pygame.draw.rect(surface, _LINKS[0], cart, border_radius=width // 2)
        # A cart has no link of its own: its pole is the second.
        first = 1 if mechanism.joints[0].unit == "m" else 0
        for index, (start, end) in enumerate(pairwise(points), first):
            pygame.draw.line(surface, _LINKS[index % 2], start, end, width)
            pygame.draw.circle(surface, _LINKS[index % 2], end, width // 2)
        driven = self._parameters.coordinates.driven
        for index, point in enumerate(points[: len(mechanism.joints) - first]):
            joint = index + first
            pygame.draw.circle(surface, _INK if joint in driven else _BACKGROUND, point, width)
            pygame.draw.circle(surface, _INK, point, width, max(2, width // 4))
        pygame.draw.circle(surface, _LINKS[(len(points) - 2 + first) % 2], points[-1], width)
        words = [self._parameters.name + ("" if time is None else f"   t = {time:.2f} s")]
        words += [
            f"{joint.name} {value:+.2f} {joint.unit}" for joint, value in zip(mechanism.joints, position, strict=True)
        ]
        for row, text in enumerate(words):
            surface.blit(self._font.render(text, True, _INK), (2 * width, 2 * width + row * self._font.get_linesize()))

    def array(self) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3)."""
        small = self._pygame.transform.smoothscale(self._surface, self._size)
        pixels: Any = self._pygame.surfarray.array3d(small)
        return np.ascontiguousarray(np.transpose(pixels, (1, 0, 2)))

    def _pixel(self, point: Point) -> tuple[int, int]:
        x, height = seen_from_the_side(self._parameters.mechanism, point)
        width, all_height = self._surface.get_size()
        return round(width / 2 + self._scale * x), round(all_height / 2 - self._scale * height)


def seen_from_the_side(mechanism: Mechanism, point: Point) -> tuple[float, float]:
    """Return where a point of a plant lies in a picture, to the right and up [m]: of one in space from a little above.

    Args:
        mechanism: The plant's equations.
        point: x, y and z [m].
    """
    x, y, z = point
    return (x, z * math.cos(_TILT) + y * math.sin(_TILT)) if mechanism.name == "furuta" else (x, z)
