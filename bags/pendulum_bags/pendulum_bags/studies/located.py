"""YAML with the line of each value, so that an error in a study file has its place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import yaml

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import load_yaml, read_text, suggestion

__all__ = ["LocatedMapping"]

Trail = tuple[Any, ...]


class LocatedMapping:
    """A mapping from the YAML file ``path`` with the lines of its keys.

    Args:
        lines: Line of each key, by the trail of keys and indices that leads to it.
        trail: Location of this mapping in the file.
    """

    def __init__(self, values: Mapping[str, Any], path: Path, lines: Mapping[Trail, int], trail: Trail = ()) -> None:
        self.values = values
        self.path = path
        self._lines = lines
        self._trail = trail

    @classmethod
    def load(cls, path: Path, what: str) -> LocatedMapping:
        """Read a file; a ParameterError if it cannot be read, is no safe YAML, or holds no mapping."""
        values = load_yaml(path, what)
        lines: dict[Trail, int] = {}
        # The strict loader has accepted this text.
        root = yaml.compose(read_text(path, what), Loader=yaml.SafeLoader)
        _collect(root, (), lines)
        return cls(values, path, lines)

    def fail(self, message: str, *trail: Any) -> NoReturn:
        """Raise a ParameterError at the line of a key, or of the mapping itself."""
        line = self._lines.get((*self._trail, *trail), self._lines.get(self._trail, 1))
        raise ParameterError(f"{self.path}:{line}: {message}")

    def reject_unknown(self, known: Iterable[str]) -> None:
        """Refuse the first key that is not known."""
        known = list(known)
        for key in self.values:
            if key not in known:
                self.fail(f"unknown key {key!r}; {suggestion(key, known)}", key)

    def get(self, key: str, kind: type | tuple[type, ...], default: Any, expected: str) -> Any:
        """Return a value of a type, or the default where it is not given; a missing value without default fails."""
        if key not in self.values:
            if default is None:
                self.fail(f"{key} is missing; expected {expected}")
            return default
        value = self.values[key]
        allowed = kind if isinstance(kind, tuple) else (kind,)
        if not isinstance(value, kind) or (isinstance(value, bool) and bool not in allowed):
            self.fail(f"{key} is {value!r}; expected {expected}", key)
        return value

    def mapping(self, key: str, default: Mapping[str, Any] | None = None) -> LocatedMapping:
        """Return the mapping under a key."""
        value = self.get(key, (dict, type(None)), default, "a mapping of names to values")
        return LocatedMapping(value or {}, self.path, self._lines, (*self._trail, key))


def _collect(node: yaml.Node | None, trail: Trail, lines: dict[Trail, int]) -> None:
    if node is None:
        return
    lines.setdefault(trail, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            below = (*trail, key.value)
            lines[below] = key.start_mark.line + 1
            _collect(value, below, lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _collect(value, (*trail, index), lines)
