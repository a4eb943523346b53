"""The fit model: one parameter vector with names, units, bounds, and its relation to plant files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.arrowhead import Model
from pendulum_bags.identification.kernel import PARAMETER_NAMES
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES, PERIODIC
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.friction_terms import FRICTION_TERMS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant

__all__ = [
    "BOUNDS",
    "FRICTION_MODELS",
    "FURTHER_TERMS",
    "INDEX",
    "PLANT_FRICTION_MODELS",
    "SERVO_ONLY",
    "TORQUES",
    "UNITS",
    "FitModel",
    "from_plant",
    "to_plant",
]

INDEX: Mapping[str, int] = {name: i for i, name in enumerate(PARAMETER_NAMES)}
"""Position of each parameter in the vector."""

FURTHER_TERMS = tuple(name for name in FRICTION_TERMS if name != "load")
"""Friction terms of plants that the kernel does not know by itself; they are fitted when asked for by name."""
_FURTHER = {name: default for term in FURTHER_TERMS for name, default in FRICTION_TERMS[term].parameters.items()}

_QUANTITIES: Mapping[str, tuple[str, float, float, float]] = {
    "inertia": ("kg m^2", 1e-7, 1e3, 1.0),
    "damping": ("N m s/rad", 0.0, 1e4, 0.0),
    "gravity": ("N m", 0.0, 1e4, 1.0),
    "coulomb_friction": ("N m", 0.0, 1e3, 0.0),
    "stribeck_excess": ("N m", 0.0, 1e3, 0.0),
    "stribeck_velocity": ("rad/s", 0.02, 2.0, 0.2),
    "load_friction": ("-", 0.0, 0.9, 0.0),
    "torque_offset": ("N m", -1e3, 1e3, 0.0),
    "angle_offset": ("rad", -0.5, 0.5, 0.0),
    "input_gain": ("N m per unit of input", -1e4, 1e4, 1.0),
    "transport_delay": ("s", -0.03, 0.1, 0.0),
    "drive_damping": ("N m s/rad", 0.0, 1e3, 0.0),
    "drive_load_friction": ("-", 0.0, 0.9, 0.0),
    "load_stribeck": ("-", 0.0, 10.0, 0.0),
    "quadratic_drag": ("N m s^2/rad^2", 0.0, 1e3, 0.0),
    **dict.fromkeys(PERIODIC, ("N m", -1e3, 1e3, 0.0)),
    # A strength may be 0; what gives a term its form stays within a thousandth and a thousandfold of its default.
    **{name: (quantity.unit, 1e-3 * value, 1e3 * value or 1e3, value) for name, (value, quantity) in _FURTHER.items()},
}
"""Unit, bounds and default of each parameter; a delay below 0 means an input stamped late."""

UNITS: Mapping[str, str] = {name: unit for name, (unit, *_) in _QUANTITIES.items()}
BOUNDS: Mapping[str, tuple[float, float]] = {name: (low, high) for name, (_, low, high, _) in _QUANTITIES.items()}
_PER_INERTIA = {
    "N m s^2/rad^2": "1/rad",
    "kg m^2": "1",
    "N m": "1/s^2",
    "N m s/rad": "1/s",
    "N m per unit of input": "1/s^2 per unit of input",
}

_STRIBECK = ("coulomb_friction", "stribeck_excess", "stribeck_velocity")
_GEAR = ("load_friction", "drive_load_friction")

FRICTION_MODELS: Mapping[str, tuple[str, ...]] = {
    "viscous": (),
    "coulomb": ("coulomb_friction",),
    "stribeck": _STRIBECK,
    "load": ("coulomb_friction", "load_friction"),
    "stribeck_load": (*_STRIBECK, "load_friction"),
    "gear_load": ("coulomb_friction", *_GEAR),
    "stribeck_gear_load": (*_STRIBECK, *_GEAR),
    "gear_load_stribeck": ("coulomb_friction", "stribeck_velocity", *_GEAR, "load_stribeck"),
    **{name: ("coulomb_friction", *FRICTION_TERMS[name].parameters) for name in FURTHER_TERMS},
}
"""Dry friction that each model adds to the viscous one, simplest first."""

SERVO_ONLY = ("stribeck_gear_load", "gear_load_stribeck")
"""Models of geared servos that are offered, but not tried, for other drives: seldom determined there."""

TORQUES: Mapping[str, tuple[str, ...]] = {
    "quadratic drag": ("quadratic_drag",),
    "a torque of twice the angle": PERIODIC[:2],
    "a torque of three times the angle": PERIODIC[2:],
}
"""Torques that may be fitted besides a friction model, in words."""

PLANT_FRICTION_MODELS = ("viscous", "coulomb", "stribeck", "load", "stribeck_load", *FURTHER_TERMS)
"""Those that a plant file can hold: its friction knows the load of gravity, not that of the drive."""

_DEFAULTS = {name: default for name, (*_, default) in _QUANTITIES.items()}
_SIZES = {"transport_delay": 1e-2, "angle_offset": 1e-1, "stribeck_velocity": 1e-1}
_SHARED = (
    *("inertia", "damping", "gravity", "coulomb_friction", "stribeck_velocity", "load_friction", "torque_offset"),
    *("angle_offset", *JOINT_TORQUES, *_FURTHER),
)
"""Parameters that the plant has by the same name."""


@dataclass(frozen=True)
class FitModel(Model):
    """Parameter values of the fit model; what drives it says ``input_kind``.

    Args:
        values: Values by name; what is missing is 0 (1 for inertia, gravity and input gain).
        input_kind: ``effort`` [N m], ``voltage`` [V] or ``position_goal`` [rad]; see ``datasets.INPUT_KINDS``.
        friction: Name of the friction model, one of ``FRICTION_MODELS``.
        duty_gain: For a servo: duty cycle per set-point error and firmware gain [1/rad].
    """

    values: Mapping[str, float]
    input_kind: str = "effort"
    friction: str = "coulomb"
    duty_gain: float = 0.0
    vector: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        values = {**_DEFAULTS, **self.values}
        for name in values.keys() - INDEX.keys():
            raise DataError(f"fit model has no parameter {name!r}; expected one of {', '.join(PARAMETER_NAMES)}")
        vector = np.array([values[name] for name in PARAMETER_NAMES], dtype=float)
        if not np.isfinite(vector).all() or vector[INDEX["inertia"]] <= 0.0:
            raise DataError(f"fit model has the values {dict(self.values)}; expected finite numbers and inertia > 0")
        vector.setflags(write=False)
        object.__setattr__(self, "vector", vector)

    def __getitem__(self, name: str) -> float:
        """Return one value by name."""
        return float(self.vector[INDEX[name]])

    @property
    def natural_frequency(self) -> float:
        """w0 = sqrt(G / J) of small swings [rad/s]."""
        return float(np.sqrt(max(self["gravity"], 0.0) / self["inertia"]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(UNITS)

    def unit(self, name: str) -> str:
        """Return the unit of a parameter, or of the natural frequency."""
        return self.units.get(name, "rad/s")

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each parameter; without a torque to compare with all are per unit of inertia."""
        if self.input_kind not in {"none", "voltage"} or self["inertia"] != 1.0:
            return UNITS
        return {name: _PER_INERTIA.get(unit, unit) for name, unit in UNITS.items()}

    def with_vector(self, vector: Array) -> FitModel:
        """Return the model with other values."""
        return replace(self, values=dict(zip(PARAMETER_NAMES, vector.tolist(), strict=True)))

    def index(self, names: Sequence[str]) -> list[int]:
        """Return the places of some parameters in the vector."""
        return [INDEX[name] for name in names]

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the domain of a parameter."""
        return BOUNDS[name]

    def size(self, name: str) -> float:
        """Return a scale of a parameter, in its unit."""
        return _SIZES.get(name, 1.0)

    def within_reach(self, other: FitModel) -> bool:
        """Return whether the inertia, which is never negative, changes fourfold at most."""
        return 0.25 * self["inertia"] <= other["inertia"] <= 4.0 * self["inertia"]


def from_plant(plant: PlantParameters) -> FitModel:
    """Return the fit model of a rigid plant; its actuator lag is folded into the delay (first order)."""
    if plant.drivetrain is not None:
        raise DataError(
            f"plant {plant.name!r} is series elastic; the fit model is rigid: expected a plant without drivetrain"
        )
    return FitModel(
        {
            **{name: getattr(plant, name) for name in _SHARED},
            "stribeck_excess": plant.static_friction - plant.coulomb_friction,
            "transport_delay": plant.transport_delay + plant.actuator_time_constant,
        },
        friction="stribeck_load",
    )


def to_plant(model: FitModel, *, name: str = "identified", effort_limit: float = 13.0) -> PlantParameters:
    """Return the plant that simulator, bridge and controller load.

    For a voltage or a servo, ``effort`` of that plant is the torque behind the input gain, and the damping is
    that with the drive switched on (back-EMF included). A delay below 0 is a matter of the recording's
    stamps, not of the plant, and is left out.
    """
    values: dict[str, Any] = {name: model[name] for name in _SHARED}
    values["damping"] += model["drive_damping"] if model.input_kind == "position_goal" else 0.0
    return pendulum_plant(
        **values,
        static_friction=model["coulomb_friction"] + model["stribeck_excess"],
        effort_limit=effort_limit,
        transport_delay=max(model["transport_delay"], 0.0),
        name=name,
    )
