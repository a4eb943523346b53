"""Units that recordings are written in, by quantity, and what else people call them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pendulum_msgs_py.errors import DataError

__all__ = ["UNITS", "factor", "input_quantity", "known_unit", "quantity_of"]

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi},
    "velocity": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180.0,
        "rev/s": 2.0 * math.pi,
        "rpm": math.pi / 30.0,
    },
    "place": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "effort": {"N m": 1.0, "Nm": 1.0, "mN m": 1e-3, "kg cm": 0.0980665},
    "force": {"N": 1.0, "mN": 1e-3},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "command": {"-": 1.0, "%": 1e-2},
}
"""Factor from each accepted unit to SI, by quantity. A command is a share, or a number of steps."""

INPUTS = ("effort", "force", "voltage", "command", "angle")
"""Quantities of what drives a joint; an angle is the set point of a servo."""

_ALSO = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "usec": "us", "µs": "us", "μs": "us", "microseconds": "us", "nsec": "ns", "nanoseconds": "ns",
    "radian": "rad", "radians": "rad", "°": "deg", "degree": "deg", "degrees": "deg", "turns": "rev",
    "rad/sec": "rad/s", "rad s^-1": "rad/s", "radps": "rad/s", "°/s": "deg/s", "deg/sec": "deg/s", "dps": "deg/s",
    "degps": "deg/s", "rev/min": "rpm", "1/min": "rpm", "volt": "V", "volts": "V", "n*m": "N m", "n·m": "N m",
    "n.m": "N m", "newton meter": "N m", "mnm": "mN m", "newton": "N", "meter": "m", "metre": "m", "meters": "m",
    "m/sec": "m/s",
}  # fmt: skip
_EXACT = {unit: unit for units in UNITS.values() for unit in units}
_FOLDED = {unit.casefold(): unit for unit in _EXACT if unit.casefold() != "mn"} | _ALSO


def known_unit(text: str) -> str:
    """Return the unit that a text stands for, as a mapping file writes it; empty for none."""
    text = text.strip().strip("[]()").strip()
    found = _EXACT.get(text) or _FOLDED.get(text.casefold(), "")
    return {"Nm": "N m"}.get(found, found)


def quantity_of(unit: str) -> str:
    """Return the quantity of a unit, such as ``angle``; empty where the unit is not known."""
    return next((quantity for quantity, units in UNITS.items() if unit in units), "")


def input_quantity(unit: object, where: str, *, reference: bool = False) -> str:
    """Return the quantity of an input by its unit, else a DataError; a reference may be a place, too."""
    known = (*INPUTS, "place") if reference else INPUTS
    for quantity in known:
        if isinstance(unit, str) and unit in UNITS[quantity]:
            return quantity
    expected = ", ".join(one for quantity in known for one in UNITS[quantity])
    raise DataError(f"{where}: unit of input is {unit!r}; expected one of {expected}")


def factor(unit: object, quantity: str, where: str) -> float:
    """Return the factor from a unit to SI; a DataError if the unit is not one of the quantity."""
    if not isinstance(unit, str) or unit not in UNITS[quantity]:
        raise DataError(f"{where} is {unit!r}; expected one of {', '.join(UNITS[quantity])}")
    return UNITS[quantity][unit]
