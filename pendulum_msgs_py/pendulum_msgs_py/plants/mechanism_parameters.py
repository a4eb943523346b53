"""Plants of several joints: a mechanism with numbers, friction and actuators.

The format ``pendulum_plant/2`` names the mechanism and its joints; an ``actuator:`` block makes a joint driven::

    format: pendulum_plant/2
    name: acrobot
    model: double_pendulum
    parameters:
      mass_1: {value: 0.523, unit: kg}
    joints:
      shoulder: {damping: {value: 0.001, unit: N m s/rad}}
      elbow:
        coulomb_friction: {value: 0.12, unit: N m}
        actuator: {effort_limit: {value: 6.0, unit: N m}}

``pendulum_plant/1``, the format of one joint, is read as the mechanism ``pendulum``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates, Vector
from pendulum_msgs_py.dynamics.joint_steps import FAR, JointTable
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import MECHANISMS, Mechanism
from pendulum_msgs_py.parameters import ParameterSpec, load_yaml, reject_unknown, require_mapping, suggestion
from pendulum_msgs_py.plants.joint_parameters import (
    Actuator,
    JointParameters,
    actuator_specs,
    check_joint,
    joint_specs,
    read_joint,
)
from pendulum_msgs_py.plants.plant_parameters import (
    FORMAT,
    MECHANISM_FORMAT,
    PLANT_SPECS,
    PlantParameters,
    read_plant_document,
    resolve_plant,
    save_document,
)
from pendulum_msgs_py.plants.quantities import (
    build_plant,
    read_name,
    read_provenance,
    read_quantities,
    write_quantities,
)

__all__ = [
    "MechanismParameters",
    "common_delay",
    "load_mechanism",
    "load_mechanism_file",
    "mechanism_from_pendulum",
    "pack_joints",
    "write_mechanism",
]

_ANGLES = 16
"""Angles of each turning joint at which the mass matrix must be positive definite."""


@dataclass(frozen=True)
class MechanismParameters:
    """A plant of n joints: a mechanism, its numbers, and what each joint has.

    Attributes:
        mechanism: Equations and joints.
        values: Values of ``mechanism.parameters``, in their order.
        joints: One entry per joint, in the order of the model.
        name: Name of the plant.

    Raises:
        ParameterError: A value is outside its domain, or the masses give no positive inertia at some position.
    """

    mechanism: Mechanism
    values: Vector
    joints: tuple[JointParameters, ...]
    name: str = field(default="unnamed", compare=False)

    def __post_init__(self) -> None:
        """Check every value."""
        specs = self.mechanism.parameters
        if len(self.values) != len(specs) or len(self.joints) != len(self.mechanism.joints):
            raise ParameterError(
                f"{self.mechanism.name} has {len(self.values)} values and {len(self.joints)} joints; "
                f"expected {len(specs)} and {len(self.mechanism.joints)}"
            )
        checked = tuple(spec.check(value) for spec, value in zip(specs, self.values, strict=True))
        object.__setattr__(self, "values", checked)
        for joint, own in zip(self.mechanism.joints, self.joints, strict=True):
            check_joint(joint, own)
        self._check_mass()

    def _check_mass(self) -> None:
        turns = [2.0 * math.pi * index / _ANGLES for index in range(_ANGLES)]
        for q in product(*((turns if joint.turns else [0.0]) for joint in self.mechanism.joints)):
            if not _positive_definite(self.mechanism.mass(q, self.packed)):
                at = ", ".join(
                    f"{joint.name} = {value:.3g} {joint.unit}"
                    for joint, value in zip(self.mechanism.joints, q, strict=True)
                )
                raise ParameterError(
                    f"the masses and inertias of {self.name!r} give no positive inertia at {at}; expected an inertia "
                    "about the joint that its mass and centre can have, at least mass * centre^2"
                )

    @cached_property
    def coordinates(self) -> Coordinates:
        """Joints, and which of them are driven."""
        driven = tuple(index for index, joint in enumerate(self.joints) if joint.actuator is not None)
        return Coordinates(self.mechanism.joints, driven)

    @cached_property
    def packed(self) -> Vector:
        """The ``p`` of the mechanism's functions: values, then the damping of each joint."""
        return (*self.values, *(joint.damping for joint in self.joints))

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Actuators of the driven joints, in the model's order."""
        return tuple(joint.actuator for joint in self.joints if joint.actuator is not None)

    @property
    def effort_limits(self) -> Vector:
        """Largest effort of each driven joint [N m or N]."""
        return tuple(actuator.effort_limit for actuator in self.actuators)

    @property
    def stops(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest position of each joint, infinite where nothing stops it [rad or m]."""
        return tuple(
            (
                -math.inf if joint.lower_stop is None else joint.lower_stop,
                math.inf if joint.upper_stop is None else joint.upper_stop,
            )
            for joint in self.joints
        )

    @property
    def has_dry_friction(self) -> bool:
        """Whether any joint has dry friction."""
        return any(joint.breakaway > 0.0 for joint in self.joints)

    @cached_property
    def specs(self) -> dict[str, ParameterSpec]:
        """Table of what :meth:`with_values` takes, by name."""
        found = {spec.name: spec for spec in self.mechanism.parameters}
        for joint, own in zip(self.mechanism.joints, self.joints, strict=True):
            mine = joint_specs(joint) + (actuator_specs(joint) if own.actuator is not None else ())
            found |= {f"{joint.name}.{spec.name}": spec for spec in mine}
        return found

    @cached_property
    def numbers(self) -> dict[str, float]:
        """All values that are given, by the names of :attr:`specs`."""
        found = {spec.name: value for spec, value in zip(self.mechanism.parameters, self.values, strict=True)}
        for joint, own in zip(self.mechanism.joints, self.joints, strict=True):
            given = {**vars(own), **({} if own.actuator is None else vars(own.actuator))}
            numbers = {key: float(value) for key, value in given.items() if isinstance(value, (int, float))}
            found |= {f"{joint.name}.{key}": value for key, value in numbers.items()}
        return found

    def value(self, name: str) -> float:
        """Return a parameter by the name that :meth:`with_values` takes.

        Raises:
            ParameterError: There is none of that name, or it is not given.
        """
        if name not in self.numbers:
            raise ParameterError(f"{name!r} is not given for plant {self.name!r}; expected {self._expected_names()}")
        return self.numbers[name]

    def with_values(self, changes: Mapping[str, float]) -> MechanismParameters:
        """Return a copy with some values changed, checked again.

        Args:
            changes: Values by name: ``mass_1``, ``elbow.damping``, ``elbow.coulomb_friction``, ``elbow.effort_limit``.

        Raises:
            ParameterError: A name is unknown, a joint is passive, or a value is outside its domain.
        """
        values, joints = list(self.values), list(self.joints)
        change: dict[str, Any]
        for name, value in changes.items():
            if name not in self.specs:
                raise ParameterError(f"unknown parameter {name!r}; expected {self._expected_names()}")
            joint, _, key = name.partition(".")
            if not key:
                values[list(self.specs).index(name)] = value
                continue
            index = self.coordinates.names.index(joint)
            own, change = joints[index], {key: value}
            if not hasattr(own, key):
                assert own.actuator is not None
                change = {"actuator": replace(own.actuator, **change)}
            joints[index] = replace(own, **change)
        return replace(self, values=tuple(values), joints=tuple(joints))

    def check_start(self, position: Sequence[float]) -> Vector:
        """Return a start position as numbers.

        Raises:
            ParameterError: It has another length, is not finite, or lies beyond an end stop.
        """
        values = tuple(float(value) for value in position)
        if len(values) != len(self.joints) or not all(map(math.isfinite, values)):
            raise ParameterError(
                f"initial position is {list(values)}; expected {len(self.joints)} finite numbers, for "
                f"{self.coordinates.with_units}"
            )
        for joint, (low, high), value in zip(self.mechanism.joints, self.stops, values, strict=True):
            if not low <= value <= high:
                raise ParameterError(
                    f"initial {joint.name} is {value} {joint.unit}; expected {low} to {high}, between its stops"
                )
        return values

    def acceleration(self, position: Vector, velocity: Vector, torque: Vector) -> Vector:
        """Return q'' under generalised forces at all n joints, dry friction apart [rad/s^2 or m/s^2].

        Args:
            position: q, n values [rad or m].
            velocity: q', n values.
            torque: n values [N m or N]; ``coordinates.spread`` makes them of those of the driven joints.
        """
        result: Vector = self.mechanism.forward(position, velocity, torque, self.packed)
        return result

    def energy(self, position: Vector, velocity: Vector) -> float:
        """Return kinetic and potential energy, 0 at rest hanging down [J]."""
        rows = self.mechanism.mass(position, self.packed)
        kinetic = sum(
            a * m * b for a, row in zip(velocity, rows, strict=True) for m, b in zip(row, velocity, strict=True)
        )
        return float(0.5 * kinetic + self.mechanism.potential(position, self.packed))

    def _expected_names(self) -> str:
        own = ", ".join(spec.name for spec in self.mechanism.parameters)
        joints = " or ".join(self.coordinates.names)
        return f"one of {own}, or JOINT.damping and the like with JOINT {joints}"


def load_mechanism(preset_or_path: str | Path) -> MechanismParameters:
    """Return the plant of a preset or of a plant file, of one joint or more.

    Raises:
        ParameterError: No such preset or file, or the file is refused; the message names file and entry.
    """
    return load_mechanism_file(preset_or_path)[0]


def load_mechanism_file(preset_or_path: str | Path) -> tuple[MechanismParameters, dict[str, Any]]:
    """Return the plant and the file's provenance (intervals included under ``intervals``).

    Raises:
        ParameterError: as :func:`load_mechanism`.
    """
    path = resolve_plant(preset_or_path)
    document = load_yaml(path, "plant file")
    if document.get("format") not in (FORMAT, MECHANISM_FORMAT):
        raise ParameterError(
            f"{path}: format is {document.get('format')!r}; expected {FORMAT!r} or {MECHANISM_FORMAT!r}"
        )
    if document["format"] == FORMAT:
        parameters, provenance = read_plant_document(document, path)
        return mechanism_from_pendulum(parameters), provenance
    return _read_document(document, path)


def mechanism_from_pendulum(parameters: PlantParameters) -> MechanismParameters:
    """Return a rigid plant of one joint as a plant of the mechanism ``pendulum``.

    Raises:
        ParameterError: The plant has what no mechanism has yet: a drivetrain, friction that grows with the load, an
            offset of angle or torque.
    """
    name = parameters.name
    if parameters.drivetrain is not None:
        raise ParameterError(f"plant {name!r} is series elastic; expected a rigid one to be read as a mechanism")
    given = {spec.name: getattr(parameters, spec.name) for spec in PLANT_SPECS}
    values = (given.pop("inertia"), given.pop("gravity"))
    actuator = Actuator(*(given.pop(name) for name in ("effort_limit", "actuator_time_constant", "transport_delay")))
    joint = {spec.name: given.pop(spec.name) for spec in joint_specs(ONE_JOINT.joints[0]) if spec.name in given}
    if joint["static_friction"] == joint["coulomb_friction"]:
        joint["static_friction"] = None
    for spec in PLANT_SPECS:
        if given.get(spec.name, spec.default) != spec.default:
            value = f"{given[spec.name]} {spec.unit}".removesuffix(" -")
            raise ParameterError(
                f"{spec.name} of plant {name!r} is {value}; expected {spec.default:g} to be read as a mechanism"
            )
    return MechanismParameters(MECHANISMS["pendulum"], values, (JointParameters(**joint, actuator=actuator),), name)


def write_mechanism(
    path: str | Path,
    parameters: MechanismParameters,
    *,
    provenance: Mapping[str, Any] | None = None,
    intervals: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Write a plant file that :func:`load_mechanism` reads back to the same values; it appears whole or not at all.

    Args:
        path: Where to write.
        parameters: The plant.
        provenance: Data, method, date: plain YAML values.
        intervals: 95 % interval by name, as ``mass_1`` or ``elbow.damping``, in the parameter's unit.

    Raises:
        ParameterError: The file cannot be written.
    """
    mechanism, known = parameters.mechanism, intervals or {}
    joints: dict[str, Any] = {}
    for joint, own in zip(mechanism.joints, parameters.joints, strict=True):
        content: dict[str, Any] = write_quantities(vars(own), joint_specs(joint), known, f"{joint.name}.")
        if own.actuator is not None:
            drive = write_quantities(vars(own.actuator), actuator_specs(joint), known, f"{joint.name}.")
            content["actuator"] = drive
        joints[joint.name] = content
    values = dict(zip(mechanism.parameter_names, parameters.values, strict=False))
    document: dict[str, Any] = {
        "format": MECHANISM_FORMAT,
        "name": parameters.name,
        "model": mechanism.name,
        "parameters": write_quantities(values, mechanism.parameters, known),
        "joints": joints,
    }
    return save_document(path, document, provenance)


def _read_document(document: Mapping[str, Any], path: Path) -> tuple[MechanismParameters, dict[str, Any]]:
    where = str(path)
    reject_unknown(document, ("format", "name", "model", "parameters", "joints", "provenance"), where=where)
    model = document.get("model")
    # Lists and mappings are neither names nor hashable.
    if not isinstance(model, str) or model not in MECHANISMS:
        given = "missing" if model is None else repr(model)
        raise ParameterError(f"{where}: model is {given}; {suggestion(model, MECHANISMS)}")
    mechanism = MECHANISMS[model]
    given_values, intervals = read_quantities(
        document.get("parameters") or {}, mechanism.parameters, f"{where}: parameters"
    )
    for spec in mechanism.parameters:
        # Those that have a natural value may be left out; a mass or a length has none.
        if spec.name not in given_values and spec.name not in {"gravity", "rotor_inertia", "gear_ratio"}:
            raise ParameterError(f"{where}: parameters.{spec.name} is missing; expected a value in {spec.unit}")
    defaults: dict[str, Any] = {spec.name: spec.default for spec in mechanism.parameters}
    values = tuple(float(value) for value in {**defaults, **given_values}.values())
    entries = require_mapping(document.get("joints"), f"{where}: joints")
    names = [joint.name for joint in mechanism.joints]
    for name in entries:
        if name not in names:
            raise ParameterError(
                f"{where}: joints has {name!r}; expected {', '.join(names)}, the joints of {mechanism.name}"
            )
    missing = [name for name in names if name not in entries]
    if missing:
        raise ParameterError(
            f"{where}: joints.{missing[0]} is missing; expected an entry for each of {', '.join(names)}"
        )
    if list(entries) != names:
        raise ParameterError(
            f"{where}: joints are {', '.join(entries)}; expected them in the order of {mechanism.name}: "
            f"{', '.join(names)}"
        )
    joints = []
    for joint in mechanism.joints:
        own, more = read_joint(joint, entries[joint.name], f"{where}: joints.{joint.name}")
        joints.append(own)
        intervals.update({f"{joint.name}.{key}": interval for key, interval in more.items()})
    parts = {"mechanism": mechanism, "values": values, "joints": tuple(joints), "name": read_name(document, path)}
    return build_plant(MechanismParameters, parts, where), read_provenance(document, where, intervals)


def _positive_definite(rows: Sequence[Sequence[float]]) -> bool:
    """Return whether a small symmetric matrix is positive definite, by the pivots of Gauss's elimination."""
    matrix = [list(row) for row in rows]
    for k, pivot_row in enumerate(matrix):
        pivot = pivot_row[k]
        if not pivot > 1e-12 * abs(rows[k][k]):
            return False
        for row in matrix[k + 1 :]:
            factor = row[k] / pivot
            for j in range(k, len(row)):
                row[j] -= factor * pivot_row[j]
    return True


def pack_joints(parameters: MechanismParameters) -> JointTable:
    """Return friction, stops and lags of the joints, as the dynamics take them: in the order of ``JOINT_ROWS``."""
    joints = parameters.joints
    return (
        tuple(joint.coulomb_friction for joint in joints),
        tuple(joint.breakaway for joint in joints),
        tuple(joint.stribeck_velocity for joint in joints),
        tuple(-FAR if joint.lower_stop is None else joint.lower_stop for joint in joints),
        tuple(FAR if joint.upper_stop is None else joint.upper_stop for joint in joints),
        tuple(0.0 if joint.actuator is None else joint.actuator.time_constant for joint in joints),
    )


def common_delay(parameters: MechanismParameters) -> float:
    """Return the transport delay of all actuators [s].

    Raises:
        ParameterError: They differ.
    """
    delays = {actuator.transport_delay for actuator in parameters.actuators}
    if len(delays) > 1:
        raise ParameterError(
            f"transport_delay is {' and '.join(f'{delay} s' for delay in sorted(delays))} on plant "
            f"{parameters.name!r}; expected the same for all actuators"
        )
    return delays.pop() if delays else 0.0
