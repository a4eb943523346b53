"""Whether a plant file determines its plant: intervals from zero up, or over orders of magnitude, allow no design."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant_file

__all__ = ["SPAN", "require_determined", "undetermined"]

SPAN = 10.0
"""Upper end over estimate, or over lower end of a size, from which on an interval determines no more than an order."""

_LONGEST = 1.0
"""Width of the interval of a time from which on it does not determine a drive [s]."""

_NONE = 0.02
"""Share of the largest torque up to which a gravity of 0 may be more: that of a pendulum that lies flat."""

_OVERDAMPED = 2.0
"""Damping ratio beyond which the inertia of a pendulum is a fast lag behind its damping, which decides instead."""


def undetermined(plant: PlantParameters, intervals: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    """Return the intervals that leave open what a design needs, by name.

    A size (inertia, gravity, mass, centre of mass) has to be positive and known to an order of magnitude; only the
    inertia of a strongly overdamped pendulum may be anything from 0 up. A friction may be 0, but not more than ten
    times the estimate, or than what stops the pendulum; a time has to be known to a second.

    Args:
        plant: The estimates.
        intervals: 95 % intervals by the names of a plant file.
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
            # What gives a friction its form matters no more than that friction.
            lost = False
        if lost:
            found[name] = (low, high)
    return found


def require_determined(preset_or_path: str | Path) -> None:
    """Refuse a plant file whose own intervals do not determine the plant.

    Raises:
        ParameterError: An interval holds 0 or spans orders of magnitude where that matters; or as ``load_plant``.
    """
    plant, provenance = load_plant_file(preset_or_path)
    for name, (low, high) in undetermined(plant, provenance["intervals"]).items():
        raise ParameterError(
            f"plant file {preset_or_path}: {name} is {plant.value(name):.4g} with the "
            f"interval {low:.4g} to {high:.4g}, which does "
            "not determine it; expected a plant that its recordings determine: identify it from a recording with more "
            "motion, or measure this value and take its interval out of the file"
        )
