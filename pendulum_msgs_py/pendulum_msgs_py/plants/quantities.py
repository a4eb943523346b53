"""Physical quantities in plant files, read and written: ``{value: NUMBER, unit: UNIT, interval: [LOW, HIGH]}``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, reject_unknown, require_mapping

__all__ = [
    "Quantity",
    "build_plant",
    "check_fields",
    "read_name",
    "read_provenance",
    "read_quantities",
    "specs_of",
    "write_quantities",
]


class Quantity(NamedTuple):
    """Annotation of a dataclass field that is a physical parameter.

    Attributes:
        unit: SI unit, ``-`` for none.
        description: Meaning, one sentence.
        positive: Zero is refused.
        signed: Negative values are allowed.
        example: Shown as the default of a required value.
        largest: Plausible maximum, or None.
    """

    unit: str
    description: str
    positive: bool = False
    signed: bool = False
    example: float = 0.0
    largest: float | None = None


def specs_of(kind: type[Any]) -> tuple[ParameterSpec, ...]:
    """Return the table of a dataclass's quantities; names and defaults are the fields'."""
    found = []
    hints = get_type_hints(kind, include_extras=True)
    # Keyword-only fields, such as friction terms, come last.
    for entry in sorted(fields(kind), key=lambda entry: bool(entry.kw_only)):
        for quantity in getattr(hints[entry.name], "__metadata__", ()):
            default = entry.default if isinstance(entry.default, float) else quantity.example
            minimum = None if quantity.signed else 0.0
            found.append(
                ParameterSpec(
                    entry.name,
                    default,
                    quantity.unit,
                    quantity.description,
                    minimum=minimum,
                    maximum=quantity.largest,
                    exclusive_minimum=quantity.positive,
                )
            )
    return tuple(found)


def read_quantities(
    entries: object, specs: Sequence[ParameterSpec], where: str
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Return values and intervals by name.

    Raises:
        ParameterError: An entry is unknown, without its unit, or refused; the message begins with ``where``.
    """
    mapping = require_mapping(entries, where)
    table = {spec.name: spec for spec in specs}
    reject_unknown(mapping, table, where=where)
    values: dict[str, float] = {}
    intervals: dict[str, list[float]] = {}
    for name, entry in mapping.items():
        spec = table[name]
        if not isinstance(entry, dict):
            raise ParameterError(f"{where}.{name} is {entry!r}; expected {{value: NUMBER, unit: {spec.unit}}}")
        reject_unknown(entry, ("value", "unit", "interval"), where=f"{where}.{name}")
        unit = entry.get("unit")
        if unit != spec.unit:
            given = "missing" if unit is None else repr(unit)
            raise ParameterError(f"{where}.{name}: unit is {given}; expected {spec.unit!r}")
        if "value" not in entry:
            raise ParameterError(f"{where}.{name}: value is missing; expected a number in {spec.unit}")
        values[name] = spec.check(entry["value"], where=where)
        if entry.get("interval") is not None:
            intervals[name] = _check_interval(entry["interval"], f"{where}.{name}", spec.unit)
    return values, intervals


def _check_interval(interval: object, where: str, unit: str) -> list[float]:
    if (
        isinstance(interval, list)
        and len(interval) == 2
        and all(type(bound) in {int, float} and abs(bound) <= sys.float_info.max for bound in interval)
        and interval[0] <= interval[1]
    ):
        return [float(bound) for bound in interval]
    raise ParameterError(f"{where}: interval is {interval!r}; expected [low, high] in {unit}")


def write_quantities(
    values: Mapping[str, Any], specs: Sequence[ParameterSpec], intervals: Mapping[str, Sequence[float]]
) -> dict[str, dict[str, Any]]:
    """Return the entries of values that are not None, with their intervals."""
    quantities: dict[str, dict[str, Any]] = {}
    for spec in specs:
        if values[spec.name] is None:
            continue
        quantities[spec.name] = {"value": float(values[spec.name]), "unit": spec.unit}
        if spec.name in intervals:
            quantities[spec.name]["interval"] = [float(bound) for bound in intervals[spec.name]]
    return quantities


def build_plant(kind: Callable[..., Any], parts: Mapping[str, Any], where: str) -> Any:
    """Return ``kind(**parts)``; a ParameterError names the file."""
    try:
        return kind(**parts)
    except ParameterError as error:
        raise ParameterError(f"{where}: {error}") from error


def check_fields(instance: object, specs: Sequence[ParameterSpec]) -> None:
    """Check the values of a frozen dataclass, and convert them to their types."""
    for spec in specs:
        object.__setattr__(instance, spec.name, spec.check(getattr(instance, spec.name)))


def read_name(document: Mapping[str, Any], path: Path) -> str:
    """Return the plant's name, by default the file's."""
    name = document.get("name", path.stem)
    if not isinstance(name, str):
        raise ParameterError(f"{path}: name is {name!r}; expected text")
    return name


def read_provenance(document: Mapping[str, Any], where: str, intervals: Mapping[str, list[float]]) -> dict[str, Any]:
    """Return the provenance of a plant file, with ``intervals``."""
    return {**require_mapping(document.get("provenance") or {}, f"{where}: provenance"), "intervals": intervals}
