"""Finding every bag, or every recording, below a folder."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from pendulum_rosbag.reader.open_source import is_bag_folder

__all__ = ["bags_below"]


def bags_below(folder: Path, suffixes: Collection[str] = ()) -> Iterator[Path]:
    """Yield bags below a folder: folders with storage files, and storage files that were given themselves."""
    if folder.is_file():
        yield folder
        return
    if is_bag_folder(folder):
        yield folder
        return
    for path in sorted(folder.iterdir()):
        # Links may form cycles; hidden folders are scratch.
        if path.is_dir() and not path.is_symlink() and not path.name.startswith("."):
            yield from bags_below(path, suffixes)
        elif path.suffix.lower() in suffixes:
            yield path
