"""Say in every text of a report that an emulator stood in for the hardware, where one did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, cast

from pendulum_bags.verdict import name_hardware

__all__ = ["name_in"]

_T = TypeVar("_T")


def name_in(value: _T, *, emulated: bool) -> _T:
    """Return a figure, a table or a part of one whose texts say ``emulated hardware`` where an emulator was used."""
    return cast("_T", _named(value)) if emulated else value


def _named(value: Any) -> Any:
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
