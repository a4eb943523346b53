"""Bags that stay open while several runs are read from them, so that decoded topics serve the next joint too."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from types import TracebackType

from pendulum_rosbag.reader import Bag, read_bag

__all__ = ["CachedBags"]


class CachedBags:
    """Opens each bag once; called as :func:`read_bag` is, within a ``with`` block that closes all of them."""

    def __init__(self) -> None:
        self._bags: dict[Path, Bag] = {}
        self._open = ExitStack()

    def __call__(self, path: str | os.PathLike[str]) -> AbstractContextManager[Bag]:
        """Return the bag, which stays open beyond the caller's own ``with`` block."""
        place = Path(path)
        if place not in self._bags:
            self._bags[place] = self._open.enter_context(read_bag(place))
        return nullcontext(self._bags[place])

    def __enter__(self) -> CachedBags:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
        self._bags.clear()
