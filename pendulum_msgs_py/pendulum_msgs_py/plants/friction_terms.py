"""Friction of the link beyond viscous, Coulomb and Stribeck friction: one function and one table entry for each term.

::

    F(v) = (tau_C + a) + (tau_S - tau_C) exp(-(v / v_s)^2),   a = sum of the magnitudes of the terms at |v|
    F    = tau_S + a(0)                                       at rest

An entry of ``FRICTION_TERMS`` defines parameters of plant files, tables and help. Simulators, emulator, designs and
identification all call :func:`added_friction`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import field, make_dataclass
from functools import cache
from types import FunctionType, ModuleType
from typing import Annotated, Any, NamedTuple

from pendulum_msgs_py.plants.quantities import Quantity

__all__ = [
    "FRICTION_TERMS",
    "STRENGTHS",
    "TERM_PARAMETERS",
    "FrictionTerm",
    "added_friction",
    "friction_of_terms",
    "modules",
    "term_fields",
    "terms_of",
    "without_terms",
]


class FrictionTerm(NamedTuple):
    """One term.

    Attributes:
        magnitude: ``magnitude(speed, weight, *parameters)``, torque against the motion, >= 0 [N m], at |v| [rad/s] and
            a carried torque of gravity |G_c sin| [N m]. A plain function of scalars and ``math``, also compiled.
        parameters: Default and meaning by name in plant files. The first is the strength; 0, its default, omits the
            term.
    """

    magnitude: Callable[..., float]
    parameters: Mapping[str, tuple[float, Quantity]]


def _load(speed: float, weight: float, load_friction: float) -> float:  # noqa: ARG001
    """Return the friction of loaded gears, l |G_c sin(theta)| [N m]."""
    return load_friction * weight


FRICTION_TERMS: Mapping[str, FrictionTerm] = {
    "load": FrictionTerm(
        _load, {"load_friction": (0.0, Quantity("-", "Dry friction per torque of gravity carried, added to tau_C."))}
    )
}
"""All terms, by name."""

TERM_PARAMETERS = tuple(name for term in FRICTION_TERMS.values() for name in term.parameters)
"""Names of all parameters, in the order of their sum's arguments."""
STRENGTHS = tuple(TERM_PARAMETERS.index(next(iter(term.parameters))) for term in FRICTION_TERMS.values())
"""Indices of the strengths."""


def term_fields() -> type[Any]:
    """Return a frozen dataclass with the parameters of all terms, the base of a joint's parameters."""
    found = [
        (name, Annotated[float, quantity], field(default=default, kw_only=True))
        for term in FRICTION_TERMS.values()
        for name, (default, quantity) in term.parameters.items()
    ]
    return make_dataclass("FrictionTerms", found, frozen=True)


@cache
def added_friction(
    names: tuple[str, ...], each: Callable[[Callable[..., float]], Any] = lambda magnitude: magnitude
) -> Callable[[float, float, Any], float]:
    """Return ``added(speed, weight, values)``, the sum of the terms [N m], as one plain function without table or loop.

    ``names`` are those of the values, in order; terms with other parameters are omitted. ``each`` is applied to each
    term's magnitude, such as ``numba.njit``.
    """
    scope: dict[str, Any] = {"__name__": __name__}
    calls = []
    for number, term in enumerate(FRICTION_TERMS.values()):
        if not set(term.parameters) <= set(names):
            continue
        scope[f"term_{number}"] = each(term.magnitude)
        values = [f"values[{names.index(name)}]" for name in term.parameters]
        # An omitted term is not called, which saves time where interpreted.
        calls.append(f"(term_{number}({', '.join(('speed', 'weight', *values))}) if {values[0]} != 0.0 else 0.0)")
    text = f"def added(speed, weight, values):\n    return {' + '.join(calls) or '0.0'}\n"
    exec(compile(text, __file__, "exec"), scope)  # noqa: S102  (own text: names and numbers of the table above)
    made: FunctionType = scope["added"]
    return made


def friction_of_terms(plant: object, weight: float) -> float:
    """Return the sum of a plant's terms at breakaway, under a carried torque of gravity [N m]."""
    return added_friction(TERM_PARAMETERS)(0.0, weight, terms_of(plant))


def terms_of(plant: object) -> tuple[float, ...]:
    """Return a plant's values of ``TERM_PARAMETERS``, 0 for missing ones."""
    return tuple(float(getattr(plant, name, 0.0)) for name in TERM_PARAMETERS)


def without_terms() -> dict[str, float]:
    """Return the changes of a plant's parameters that omit every term."""
    return {TERM_PARAMETERS[index]: 0.0 for index in STRENGTHS}


def modules() -> list[ModuleType]:
    """Return the modules of the terms, for caches of machine code."""
    return [sys.modules[name] for name in {__name__, *(term.magnitude.__module__ for term in FRICTION_TERMS.values())}]
