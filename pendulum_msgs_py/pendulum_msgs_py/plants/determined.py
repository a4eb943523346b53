"""Whether a plant file determines its plant: intervals from zero up, or over orders of magnitude, allow no design."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant_file

__all__ = ["SPAN", "require_determined", "undetermined"]

SPAN = 10.0
"""Ratio of upper end to estimate, or to lower end, from which on an interval is too wide."""

_LONGEST = 1.0
"""Width from which on the interval of a time is too wide [s]."""

_NONE = 0.02
"""Share of the largest torque below which a gravity of 0 counts as a pendulum that lies flat."""

_OVERDAMPED = 2.0
"""Damping ratio above which the inertia is a fast lag, and the damping decides instead."""


def undetermined(plant: PlantParameters, intervals: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Return those 95 % intervals, by names of a plant file, that leave open what a design needs.

    Sizes (inertia, gravity, mass, centre) must be positive and known to a factor of ten; only the inertia of a strongly
    overdamped pendulum may include 0. A friction may be 0, but not exceed ten times the estimate or what stops the
    pendulum; a time must be known to a second.
    """
    values = plant.numbers
    sizes = {spec.name for spec in plant.mechanism.parameters}
    if plant.is_pendulum:
        largest = plant.gravity or plant.effort_limit
        critical = 2.0 * math.sqrt(plant.inertia * plant.gravity) or plant.effort_limit
    else:
        largest = critical = max(plant.effort_limits) if plant.actuators else math.inf
    found = {}
    for name, (low, high) in intervals.items():
        value = values.get(name.split(" ")[0])
        if value is None:
            continue
        kind = name.rsplit(".", 1)[-1]
        if name in sizes:
            lost = (low <= 0.0 or high > SPAN * low) if value > 0.0 else high > _NONE * largest
            if lost and name == "inertia" and plant.is_pendulum and high <= SPAN * value:
                lost = not plant.damping >= 2.0 * _OVERDAMPED * math.sqrt(high * plant.gravity) > 0.0
        elif kind in {"transport_delay", "time_constant", "actuator_time_constant"}:
            lost = high - low > _LONGEST
        elif kind == "angle_offset":
            lost = high - low > math.pi
        elif kind == "torque_offset":
            lost = high - low > 2.0 * SPAN * max(abs(value), largest)
        elif kind in {"damping", "coulomb_friction", "static_friction"}:
            lost = high > SPAN * max(value, critical if kind == "damping" else largest)
        else:
            # The shape of a friction matters no more than that friction.
            lost = False
        if lost:
            found[name] = (low, high)
    return found


def require_determined(preset_or_path: str | Path) -> None:
    """Raise a ParameterError for a plant file whose intervals do not determine the plant, or as ``load_plant``."""
    plant, provenance = load_plant_file(preset_or_path)
    for name, (low, high) in undetermined(plant, provenance["intervals"]).items():
        raise ParameterError(
            f"plant file {preset_or_path}: {name} is {plant.value(name):.4g} with the "
            f"interval {low:.4g} to {high:.4g}, which does "
            "not determine it; expected a plant that its recordings determine: identify it from a recording with more "
            "motion, or measure this value and take its interval out of the file"
        )
