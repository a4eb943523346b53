"""What ``pip install`` of one of our wheels brings, by what the installed packages say of themselves.

The environment holds the whole lock, so nothing has to be installed anew. The rows of the table in
``install.md``, as they should be::

    python -m tests.wheel_sizes
"""

from __future__ import annotations

import re
from functools import cache
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from pendulum_testing.fixtures import PROJECT

__all__ = ["PAGE", "Row", "as_installed", "of_page"]

PAGE = PROJECT / "pendulum_msgs_py" / "docs" / "install.md"
Row = tuple[int, float]
"""Number of packages, and size of their files [MB]."""

_ROW = re.compile(r"^\| `(pendulum_\w+(?:\[[\w,]+\])?)`(.*?) \| (\d+) \| (\d+) \|$", re.MULTILINE)


def of_page() -> dict[str, Row]:
    """Return what the page says: wheel with its extras -> row."""
    rows = _ROW.findall(PAGE.read_text(encoding="utf-8"))
    return {wheel: (int(packages), float(size)) for wheel, _, packages, size in rows}


def as_installed(wheel: str) -> Row:
    """Return what a wheel needs, itself counted, without compiled modules.

    Args:
        wheel: Its name, with its extras in brackets.
    """
    extras: dict[str, frozenset[str]] = {}
    asked = [Requirement(wheel)]
    while asked:
        requirement = asked.pop()
        name = canonicalize_name(requirement.name)
        wanted = extras.get(name, frozenset()) | requirement.extras | {""}
        if wanted == extras.get(name):
            continue
        extras[name] = wanted
        asked += [
            entry
            for entry in map(Requirement, distribution(name).requires or [])
            if entry.marker is None or any(entry.marker.evaluate({"extra": extra}) for extra in wanted)
        ]
    return len(extras), sum(_size(name) for name in extras) / 1e6


@cache
def _size(name: str) -> int:
    """Return the size of a package's files [bytes]."""
    if name.startswith("pendulum-"):
        # Ours are linked, so what they say of themselves is the link.
        spec = find_spec(name.replace("-", "_"))
        assert spec is not None
        assert spec.origin is not None
        paths = list(Path(spec.origin).parent.rglob("*"))
    else:
        found = distribution(name)
        paths = [Path(str(found.locate_file(file))) for file in found.files or []]
    return sum(path.stat().st_size for path in paths if path.suffix != ".pyc" and path.is_file())


if __name__ == "__main__":
    for label, text, _, _ in _ROW.findall(PAGE.read_text(encoding="utf-8")):
        count, megabytes = as_installed(label)
        print(f"| `{label}`{text} | {count} | {megabytes:.0f} |")
