"""Names emulated hardware ``emulated hardware`` in texts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from typing import Any, TypeVar, cast

from pendulum_bags.runs.case import Case

__all__ = ["name_hardware", "name_in"]

_T = TypeVar("_T")
_HARDWARE = re.compile(r"(?<![-/\w])(?<!emulated )(H|h)ardware\b(?!/)")


def name_hardware(text: str, *, emulated: bool) -> str:
    """Return a text with ``emulated hardware`` in place of hardware if it was emulated."""
    if not emulated:
        return text
    return _HARDWARE.sub(lambda found: "Emulated hardware" if found[1] == "H" else "emulated hardware", text)


def name_in(value: _T, *, emulated: bool) -> _T:
    """Return a figure, table, layer or part of one with its texts changed likewise."""
    return cast("_T", _named(value)) if emulated else value


def _named(value: Any) -> Any:
    if isinstance(value, (Enum, Case)):
        return value
    if isinstance(value, str):
        return name_hardware(value, emulated=True)
    if isinstance(value, (list, tuple)):
        return type(value)(_named(item) for item in value)
    if isinstance(value, Mapping):
        return {key: _named(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        changed = {field.name: _named(getattr(value, field.name)) for field in fields(value) if field.init}
        return replace(value, **changed)
    return value
