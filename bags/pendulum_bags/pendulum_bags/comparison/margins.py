"""Acceptable differences, stated by the user in units of the task, in one file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, TypeAlias

from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import load_yaml, reject_unknown, require_mapping

__all__ = ["Margin", "MarginArgument", "Margins"]

FORMAT = "pendulum_margins/1"
SHARE = "%"
_FACTORS = {
    "deg": math.pi / 180.0,
    "rad": 1.0,
    "deg/s": math.pi / 180.0,
    "rad/s": 1.0,
    "ms": 1e-3,
    "s": 1.0,
    "mm": 1e-3,
    "m": 1.0,
    "N m": 1.0,
    "Hz": 1.0,
    SHARE: 0.01,
}
"""From what a user may write to SI."""
_UNITS: Mapping[str, tuple[str, ...]] = {
    "mean_angle": ("deg", "rad"),
    "spread_angle": (SHARE, "deg", "rad"),
    "spread_velocity": (SHARE, "deg/s", "rad/s"),
    "spread_torque": (SHARE, "N m"),
    "delay": ("ms", "s"),
    "path_angle": (SHARE, "deg", "rad"),
    "path_velocity": (SHARE, "deg/s", "rad/s"),
    "band": ("Hz",),
    "mean_position": ("mm", "m"),
}
"""Units of each entry; the first is the one of a number that a program gives without; a text has its unit."""


@dataclass(frozen=True)
class Margin:
    """One margin > 0 in its unit; ``%`` for a share of the hardware's own spread."""

    value: float
    unit: str

    @property
    def is_share(self) -> bool:
        """Whether it is a share of the hardware's spread."""
        return self.unit == SHARE

    @property
    def si(self) -> float:
        """Value in SI units; 0.15 for 15 %."""
        return self.value * _FACTORS[self.unit]

    @property
    def per_si(self) -> float:
        """Factor from SI to its unit."""
        return 1.0 / _FACTORS[self.unit]

    def __str__(self) -> str:
        """Return it as a user would write it."""
        return f"{self.value:g} {self.unit}"


@dataclass(frozen=True)
class Margins:
    """Acceptable differences; a margin that is not given is that of ``margins.yaml`` of the package.

    Args:
        spread_angle, spread_velocity, spread_torque: Of the standard deviations: in a unit, or as a share, which allows
            factors from 1 / (1 + share) to 1 + share.
        stated: Names of the margins that the user stated; the verdict reports them.
    """

    mean_angle: Margin
    spread_angle: Margin
    spread_velocity: Margin
    spread_torque: Margin
    delay: Margin
    path_angle: Margin
    path_velocity: Margin
    band: Margin
    mean_position: Margin
    stated: frozenset[str] = field(default=frozenset(), compare=False)

    @classmethod
    def parse(cls, margin: MarginArgument = None) -> Margins:
        """Return margins from None for the defaults, a margins file, a mapping of names to values, texts, or margins.

        Texts are such as ``delay=8 ms`` or ``spread_angle=0.2 deg``. A ParameterError for an unknown name, a unit of
        another quantity, or a value out of domain.
        """
        if isinstance(margin, Margins):
            return margin
        stated: dict[str, Margin] = {}
        if margin is None:
            pass
        elif isinstance(margin, Mapping):
            stated = {name: _margin(name, value) for name, value in margin.items()}
        elif isinstance(margin, os.PathLike):
            stated = _read(Path(margin))
        else:
            texts = margin.split(",") if isinstance(margin, str) else margin
            if not isinstance(texts, Sequence):
                raise ParameterError(f"margin is {margin!r}; expected NAME=VALUE, such as delay=8ms")
            stated = _parse_texts(texts)
        return cls(**{**_defaults(), **stated}, stated=frozenset(stated))

    @classmethod
    def of(cls, file: Path | None, texts: Sequence[str] | None) -> Margins:
        """Return the margins of a file, or the defaults, overridden by texts such as ``delay=8 ms``."""
        base = cls.parse(file)
        stated = _parse_texts(texts or ())
        return replace(base, **stated, stated=base.stated | frozenset(stated))

    @classmethod
    def of_run(cls, folder: Path) -> Margins | None:
        """Return the margins with which a run folder was last compared, or None; a ParameterError if damaged."""
        path = folder / _OF_RUN
        return cls.parse(path) if path.is_file() else None

    def keep(self, folder: Path) -> Path:
        """Store the stated margins in a run folder, as a margins file (JSON is YAML, too); return the file."""
        path = folder / _OF_RUN
        content = self.as_dict()
        write_json(path, {"format": FORMAT, "margins": {name: content[name] for name in sorted(self.stated)}})
        return path

    @property
    def whose(self) -> str:
        """Source of these margins, as text."""
        if not self.stated:
            return "the default margins (none were stated)"
        if all(name in self.stated for name in _UNITS):
            return "the stated margins"
        stated = ", ".join(name for name in _UNITS if name in self.stated)
        return f"the stated margins ({stated}) and the default ones for the rest"

    def as_dict(self) -> dict[str, Any]:
        """Return value and unit of each for JSON, and which were stated."""
        values = {name: getattr(self, name) for name in _UNITS}
        return {
            **{name: {"value": one.value, "unit": one.unit} for name, one in values.items()},
            "stated": sorted(self.stated),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Margins:
        """Return margins from the output of :meth:`as_dict`, or raise a ParameterError."""
        stated = [name for name in content.get("stated", ()) if name in _UNITS]
        return cls.parse({name: f"{content[name]['value']} {content[name]['unit']}" for name in stated})


_OF_RUN = "margins.yaml"
MarginArgument: TypeAlias = "Margins | Mapping[str, Any] | Sequence[str] | os.PathLike[str] | None"


@lru_cache(maxsize=1)
def _defaults() -> dict[str, Margin]:
    with resources.as_file(resources.files("pendulum_bags.comparison").joinpath("margins.yaml")) as path:
        found = _read(path)
    assert set(found) == {one.name for one in fields(Margins)} - {"stated"}
    return found


def _read(path: Path) -> dict[str, Margin]:
    document = load_yaml(path, "margins file")
    reject_unknown(document, ("format", "margins"), where=str(path))
    if document.get("format") != FORMAT:
        raise ParameterError(f"{path}: format is {document.get('format')!r}; expected {FORMAT!r}")
    entries = require_mapping(document.get("margins"), f"{path}: margins")
    return {name: _margin(name, entry, f"{path}: ") for name, entry in entries.items()}


def _margin(name: str, given: Any, where: str = "") -> Margin:
    if name not in _UNITS:
        raise ParameterError(f"{where}margin has no {name!r}; expected one of {', '.join(_UNITS)}")
    unit = ""
    value = given
    if isinstance(given, Mapping):
        reject_unknown(given, ("value", "unit"), where=f"{where}margin {name}")
        value, unit = given.get("value"), str(given.get("unit", ""))
    elif isinstance(given, str):
        number = given.strip()
        for ending in sorted(_UNITS[name], key=len, reverse=True):
            if number.endswith(ending):
                number, unit = number[: -len(ending)].strip(), ending
                break
        value = number
    try:
        value = float(value)
    except (TypeError, ValueError) as error:
        units = ", ".join(_UNITS[name])
        raise ParameterError(f"{where}margin {name} is {given!r}; expected a number in {units}") from error
    unit = unit or _UNITS[name][0]
    if unit not in _UNITS[name]:
        raise ParameterError(f"{where}margin {name} has unit {unit!r}; expected one of {', '.join(_UNITS[name])}")
    if not (math.isfinite(value) and value > 0.0):
        raise ParameterError(f"{where}margin {name} is {value:g} {unit}; expected a finite number > 0")
    return Margin(value, unit)


def _parse_texts(texts: Sequence[str]) -> dict[str, Margin]:
    stated: dict[str, Margin] = {}
    for name, margin in map(_parse_text, texts):
        if name in stated:
            raise ParameterError(f"margin {name} is stated twice; expected once")
        stated[name] = margin
    return stated


def _parse_text(text: str) -> tuple[str, Margin]:
    name, sign, value = text.partition("=")
    if not sign:
        raise ParameterError(f"margin is {text!r}; expected NAME=VALUE, such as delay=8ms")
    name = name.strip()
    if name in _UNITS and not any(value.strip().endswith(unit) for unit in _UNITS[name]):
        units = " or ".join(_UNITS[name])
        raise ParameterError(f"margin {name} is {value.strip()!r}, without a unit; expected a number in {units}")
    return name, _margin(name, value)
