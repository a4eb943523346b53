"""Friction of the link beyond viscous, Coulomb and Stribeck friction: one function and one line for each term.

::

    F(v) = (tau_C + a) + (tau_S - tau_C) exp(-(v / v_s)^2),   a = sum of the magnitudes of the terms at |v|
    F    = tau_S + a(0)                                       at rest

A line of ``FRICTION_TERMS`` defines a plant's parameters, with unit and default, in plant files, tables and help. The
simulators, single and in batches, the emulated actuator, the designs' friction and ``identify`` all call
:func:`added_friction` for the sum of them.
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
        magnitude: ``magnitude(speed, weight, *parameters)``, the torque against the motion, >= 0 [N m], at a speed
            |v| >= 0 [rad/s] and a torque of gravity that is carried, |G_c sin| >= 0 [N m]. A plain function of scalars
            and ``math``: it is interpreted, compiled and differentiated.
        parameters: Default and meaning of each, by its name in plant files. The first is the term's strength: 0, its
            default, leaves the term out.
    """

    magnitude: Callable[..., float]
    parameters: Mapping[str, tuple[float, Quantity]]


def _load(speed: float, weight: float, load_friction: float) -> float:  # noqa: ARG001
    """Return what gears add that carry a load, l |G_c sin(theta)| [N m]."""
    return load_friction * weight


FRICTION_TERMS: Mapping[str, FrictionTerm] = {
    "load": FrictionTerm(
        _load, {"load_friction": (0.0, Quantity("-", "Dry friction per torque of gravity carried, added to tau_C."))}
    )
}
"""All terms, by name."""

TERM_PARAMETERS = tuple(name for term in FRICTION_TERMS.values() for name in term.parameters)
"""Names of their parameters, in the order in which their sum takes them."""
STRENGTHS = tuple(TERM_PARAMETERS.index(next(iter(term.parameters))) for term in FRICTION_TERMS.values())
"""Which of these are strengths: where all are 0, there is no term."""


def term_fields() -> type[Any]:
    """Return a frozen dataclass with the parameters of all terms, for a plant's parameters to begin with."""
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
    """Return ``added(speed, weight, values)``, what the terms add to dry friction [N m], as one plain function.

    It is written out, so that compilers see neither table nor loop.

    Args:
        names: What the values will be, in their order; a term whose parameters are not among them is left out.
        each: Made of each term's magnitude before it is called, such as ``numba.njit``.
    """
    scope: dict[str, Any] = {"__name__": __name__}
    calls = []
    for number, term in enumerate(FRICTION_TERMS.values()):
        if not set(term.parameters) <= set(names):
            continue
        scope[f"term_{number}"] = each(term.magnitude)
        values = [f"values[{names.index(name)}]" for name in term.parameters]
        # One that is absent is not called: interpreted plants would wait for it.
        calls.append(f"(term_{number}({', '.join(('speed', 'weight', *values))}) if {values[0]} != 0.0 else 0.0)")
    text = f"def added(speed, weight, values):\n    return {' + '.join(calls) or '0.0'}\n"
    exec(compile(text, __file__, "exec"), scope)  # noqa: S102  (own text: names and numbers of the table above)
    made: FunctionType = scope["added"]
    return made


def friction_of_terms(plant: object, weight: float) -> float:
    """Return what the terms add to the dry friction of a plant that begins to slide [N m].

    Args:
        plant: Its parameters; terms that it has not are absent.
        weight: Torque of gravity that is carried, >= 0 [N m].
    """
    return added_friction(TERM_PARAMETERS)(0.0, weight, terms_of(plant))


def terms_of(plant: object) -> tuple[float, ...]:
    """Return the values of ``TERM_PARAMETERS`` of a plant; what it has not is absent, 0."""
    return tuple(float(getattr(plant, name, 0.0)) for name in TERM_PARAMETERS)


def without_terms() -> dict[str, float]:
    """Return the changes of a plant's parameters that leave every term out."""
    return {TERM_PARAMETERS[index]: 0.0 for index in STRENGTHS}


def modules() -> list[ModuleType]:
    """Return the modules of the terms; caches of machine code compare their age."""
    return [sys.modules[name] for name in {__name__, *(term.magnitude.__module__ for term in FRICTION_TERMS.values())}]
