"""Does the fit agree with scales and rulers? A loud warning, because published identifications did not."""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_bags.identification.model import BOUNDS, FitModel
from pendulum_bags.identification.options import GRAVITY, Geometry
from pendulum_bags.identification.uncertainty import Uncertainty

__all__ = ["CONTRADICTION", "GeometryCheck", "check_geometry"]

CONTRADICTION = "CONTRADICTION"
"""How the sentence begins that identification and geometry exclude each other."""

TOLERANCE = 0.05
"""Relative difference that tape and kitchen scales explain."""


@dataclass(frozen=True)
class GeometryCheck:
    """Comparison of the fit with known mass, length, inertia.

    Args:
        rows: (quantity, unit, from geometry, identified, low, high, agrees).
        sentences: The outcome in words; contradictions begin with CONTRADICTION.
        contradicts: Whether anything disagrees.
    """

    rows: tuple[tuple[str, str, float, float, float, float, bool], ...]
    sentences: tuple[str, ...]
    contradicts: bool


def check_geometry(model: FitModel, uncertainty: Uncertainty, geometry: Geometry) -> GeometryCheck | None:
    """Compare gravity with m g l, inertia with the known one or its least, m l^2, and w0; None where none is known."""
    normalised = model.input_kind in {"voltage", "none"} and "inertia" not in uncertainty.intervals
    rows: list[tuple[str, str, float, float, float, float, bool]] = []
    said: list[str] = []

    def compare(name: str, unit: str, known: float, value: float) -> None:
        interval = uncertainty.intervals.get(name)
        low, high = (interval.low, interval.high) if interval else (value, value)
        agrees = bool(low * (1.0 - TOLERANCE) <= known <= high * (1.0 + TOLERANCE))
        rows.append((name, unit, known, value, low, high, agrees))
        if not agrees:
            said.append(
                f"{CONTRADICTION}: {name} is {value:.4g} {unit} by identification "
                f"(95 % interval {low:.4g} to {high:.4g}) but {known:.4g} {unit} by geometry, "
                f"a factor of {value / known:.2g}."
            )

    known_gravity = geometry.gravity
    # A gravity at the edge of its domain has no interval, and contradicts all the more.
    at_edge = model["gravity"] in BOUNDS["gravity"]
    if known_gravity is not None and not normalised and ("gravity" in uncertainty.intervals or at_edge):
        compare("gravity", "N m", known_gravity, model["gravity"])
    if geometry.inertia is not None and not normalised:
        compare("inertia", "kg m^2", geometry.inertia, model["inertia"])
    elif geometry.least_inertia is not None and not normalised:
        interval = uncertainty.intervals.get("inertia")
        high = interval.high if interval else model["inertia"]
        least = geometry.least_inertia
        agrees = bool(high * (1.0 + TOLERANCE) >= least)
        low = interval.low if interval else model["inertia"]
        rows.append(("inertia (least)", "kg m^2", least, model["inertia"], low, high, agrees))
        if not agrees:
            said.append(
                f"{CONTRADICTION}: inertia is {model['inertia']:.4g} kg m^2 by identification, yet a mass of "
                f"{geometry.mass:g} kg at {geometry.length:g} m alone has {least:.4g} kg m^2."
            )
    if geometry.length is not None and geometry.inertia is None:
        fastest = (GRAVITY / geometry.length) ** 0.5
        w0 = uncertainty.intervals.get("natural_frequency")
        if w0 is not None and w0.low > fastest * (1.0 + TOLERANCE):
            said.append(
                f"{CONTRADICTION}: w0 is {w0.value:.3f} rad/s, but a centre of mass at {geometry.length:g} m "
                f"cannot swing faster than sqrt(g / l) = {fastest:.3f} rad/s."
            )
    if known_gravity is not None and geometry.inertia is not None:
        compare("natural_frequency", "rad/s", (known_gravity / geometry.inertia) ** 0.5, model.natural_frequency)
    if not rows and not said:
        return None
    contradicts = any(s.startswith(CONTRADICTION) for s in said)
    if contradicts:
        said.append(
            "Check the unit and calibration of the recorded torque, mass and length; `--fix-scale` takes the scale "
            "from the geometry and fits the gain of the recorded torque instead."
        )
    else:
        ratios = ", ".join(f"{name} {value / known:.2f}" for name, _, known, value, *_ in rows)
        said.append(f"Identification and geometry agree within their intervals (identified over geometry: {ratios}).")
    return GeometryCheck(tuple(rows), tuple(said), contradicts)
