"""Pictures on the screen and in files."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.pictures.canvas import Picture

__all__ = ["Window", "save_gif", "save_png"]


_EXPECTED = "expected a display (ssh -X, or window:=false with png or gif)"
_INVISIBLE = ("dummy", "offscreen", "evdev", "kmsdrm")


class Window:
    """A window for pictures of a size [px]; raises a ParameterError without a display."""

    def __init__(self, size: tuple[int, int], title: str = "pendulum") -> None:
        import pygame

        self.closed = False
        self._pygame = pygame
        chosen = os.environ.get("SDL_VIDEODRIVER", "")
        if sys.platform == "linux" and not (chosen or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))):
            raise ParameterError(f"DISPLAY and WAYLAND_DISPLAY are not set, so there is no window; {_EXPECTED}")
        try:
            pygame.display.init()
            # SDL falls back to invisible drivers.
            if (driver := pygame.display.get_driver()) in _INVISIBLE and driver != chosen:
                pygame.display.quit()
                raise ParameterError(f"no window can be opened, {driver} shows none; {_EXPECTED}")
            self._screen = pygame.display.set_mode(size)
        except pygame.error as error:
            raise ParameterError(f"no window can be opened: {error}; {_EXPECTED}") from error
        pygame.display.set_caption(title)
        self._clock = pygame.time.Clock()

    def show(self, picture: Picture, *, fps: int = 0) -> None:
        """Show a picture; wait for at most ``fps`` pictures per second, 0 for no wait."""
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
    """Write a picture of shape (height, width, 3) as PNG; a ParameterError if that fails."""
    return _save(path, [picture], "PNG")


def save_gif(path: str | Path, pictures: Sequence[NDArray[np.uint8]], fps: float) -> Path:
    """Write at least one picture of shape (height, width, 3) as GIF; a ParameterError if that fails."""
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
