"""Physical parameters of a plant: one type, one YAML format, shared by simulation, design and identification.

Each value carries its unit; other units are refused. ``pendulum_plant/2`` names a mechanism and its joints, of which
those with an ``actuator:`` are driven::

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

An actuator with ``motor:`` (resistance, torque_constant, voltage_limit, ...) in place of ``effort_limit`` is commanded
in volts. ``pendulum_plant/1`` lists the numbers of one driven hinge::

    format: pendulum_plant/1
    name: thesis
    parameters:
      inertia: {value: 0.055, unit: kg m^2}
      damping: {value: 11.77, unit: N m s/rad, interval: [11.70, 11.84]}
      gravity: {value: 1.678, unit: N m}
    drivetrain: {...}      # only for a series-elastic plant
    provenance: {...}      # optional, in both: data, method, date
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.contract.joints import Coordinates, Joint, Vector
from pendulum_msgs_py.dynamics.joint_steps import FAR, JointTable
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import MECHANISMS, Mechanism
from pendulum_msgs_py.mechanisms.mechanism import TORQUES_SUFFIX
from pendulum_msgs_py.parameters import (
    ParameterSpec,
    dump_yaml,
    parse_yaml,
    read_text,
    reject_unknown,
    require_mapping,
    suggestion,
)
from pendulum_msgs_py.plants.friction_terms import STRENGTHS, TERM_PARAMETERS
from pendulum_msgs_py.plants.joint_parameters import (
    DRIVETRAIN_SPECS,
    OF_A_PENDULUM,
    Actuator,
    JointParameters,
    Motor,
    SeriesElasticParameters,
    actuator_specs,
    joint_specs,
    motor_specs,
)
from pendulum_msgs_py.plants.quantities import (
    build_plant,
    read_name,
    read_provenance,
    read_quantities,
    write_quantities,
)

__all__ = [
    "FORMAT",
    "MECHANISM_FORMAT",
    "MECHANISM_PRESETS",
    "PLANT_SPECS",
    "PRESETS",
    "PRESET_NAMES",
    "SEALED_FORMAT",
    "SERIES_ELASTIC_PRESETS",
    "PlantParameters",
    "common_delay",
    "is_mechanism",
    "load_mechanism",
    "load_plant",
    "load_plant_file",
    "pack_joints",
    "pendulum_plant",
    "plant_document",
    "read_plant_document",
    "require_one_joint",
    "resolve_plant",
    "write_plant",
]

FORMAT = "pendulum_plant/1"
MECHANISM_FORMAT = "pendulum_plant/2"
SEALED_FORMAT = "pendulum_plant_sealed/1"
"""See :mod:`pendulum_msgs_py.plants.sealed_plant`."""
_PRESET_FOLDER = Path(str(resources.files("pendulum_msgs_py.plants") / "presets"))
_PRESET_TEXTS = {
    file.stem: file.read_text(encoding="utf-8")
    for file in sorted(_PRESET_FOLDER.glob("*.yaml"), key=lambda file: (file.stem != "thesis", file.stem))
}
MECHANISM_PRESETS = tuple(
    name for name, text in _PRESET_TEXTS.items() if f"\nformat: {MECHANISM_FORMAT}" in f"\n{text}"
)
"""Presets of several joints."""
PRESETS = tuple(name for name in _PRESET_TEXTS if name not in MECHANISM_PRESETS)
"""Presets of one joint: the files of the folder, the default first."""
PRESET_NAMES = ", ".join(PRESETS)
SERIES_ELASTIC_PRESETS = tuple(name for name in PRESETS if "\ndrivetrain:" in _PRESET_TEXTS[name])
"""Presets with a drivetrain."""

_PENDULUM = MECHANISMS["pendulum"]
_REQUIRED = ("inertia", "damping", "gravity")
"""Required in a file of a pendulum."""
_EXAMPLES = {"damping": 11.77, "effort_limit": 13.0}
"""Defaults of a single joint where they differ; a foreign simulation's effort may be of any size."""
_ANGLES = 16
"""Angles of each turning joint at which the mass matrix is checked."""
_LATE = 0.05
"""Share of a joint's inertia by which its motor's inductance may be felt, beyond a lag."""


class _Place(NamedTuple):
    """A number of a plant: in ``values``, a ``joint``, its ``actuator`` or ``motor`` (the part), by index and field."""

    spec: ParameterSpec
    part: str
    number: int
    key: str
    where: str


@cache
def _places(mechanism: Mechanism) -> dict[str, _Place]:
    """Return the places of a mechanism's numbers by name: ``elbow.damping``, or of one joint ``damping``."""
    found = {spec.name: _Place(spec, "values", index, spec.name, "") for index, spec in enumerate(mechanism.parameters)}
    several = len(mechanism.joints) > 1
    for index, joint in enumerate(mechanism.joints):
        for part, specs in (
            ("joint", joint_specs(joint) if mechanism.model == _PENDULUM.name else _format_2(joint)),
            ("actuator", actuator_specs(joint)),
            ("motor", motor_specs(joint)),
        ):
            for spec in specs:
                name, shown, where = _name(mechanism, joint, spec.name), spec, ""
                if several:
                    where = {"joint": joint.name, "actuator": f"{joint.name}.actuator"}.get(part, f"{joint.name}.motor")
                else:
                    shown = replace(spec, name=name, default=_EXAMPLES.get(name, spec.default), maximum=None)
                found[name] = _Place(shown, part, index, spec.name, where)
    if several:
        return found
    # As in files: required ones first, friction terms and joint torques last.
    order = {name: rank for rank, name in enumerate(_REQUIRED, -len(_REQUIRED))}
    order |= {**dict.fromkeys(TERM_PARAMETERS, 1), **dict.fromkeys(JOINT_TORQUES, 2)}
    return dict(sorted(found.items(), key=lambda each: order.get(each[0], 0)))


def _name(mechanism: Mechanism, joint: Joint, key: str) -> str:
    if len(mechanism.joints) > 1:
        return f"{joint.name}.{key}"
    return "actuator_time_constant" if key == "time_constant" else key


def _format_2(joint: Joint) -> tuple[ParameterSpec, ...]:
    return tuple(spec for spec in joint_specs(joint) if spec.name not in OF_A_PENDULUM)


PLANT_SPECS = tuple(
    place.spec
    for name, place in _places(_PENDULUM).items()
    if name not in {"lower_stop", "upper_stop"} and place.part != "motor"
)
"""Quantities of a pendulum, in the order of a plant file."""


class _Pendulum:
    """Attributes of a plant with ``is_pendulum``; other plants have :meth:`PlantParameters.value` only.

    ::

        M_c theta'' + b_c theta' + friction + G_c sin(theta) = u + d
    """

    inertia: float
    damping: float
    gravity: float
    coulomb_friction: float
    static_friction: float
    stribeck_velocity: float
    torque_offset: float
    angle_offset: float
    effort_limit: float
    actuator_time_constant: float
    transport_delay: float
    load_friction: float
    quadratic_drag: float
    torque_cos_2: float
    torque_sin_2: float
    torque_cos_3: float
    torque_sin_3: float


@dataclass(frozen=True)
class PlantParameters(_Pendulum):
    """A plant of n joints: a mechanism, the values of its parameters in order, and the parameters of each joint.

    Raises:
        ParameterError: A value is outside its domain, or the mass matrix is not positive definite at some position.
    """

    mechanism: Mechanism
    values: Vector
    joints: tuple[JointParameters, ...]
    name: str = field(default="unnamed", compare=False)

    def __post_init__(self) -> None:
        torques = TORQUES_SUFFIX if any(any(own.torques) for own in self.joints) else ""
        object.__setattr__(self, "mechanism", MECHANISMS[f"{self.mechanism.model}{torques}"])
        specs = self.mechanism.parameters
        if len(self.values) != len(specs) or len(self.joints) != len(self.mechanism.joints):
            raise ParameterError(
                f"{self.mechanism.name} has {len(self.values)} values and {len(self.joints)} joints; "
                f"expected {len(specs)} and {len(self.mechanism.joints)}"
            )
        changes = {}
        for place in self._places.values():
            value = self._at(place)
            if value is not None and (checked := place.spec.check(value, where=place.where)) is not value:
                changes[place] = checked
            if place.key == "static_friction" and value == self.joints[place.number].coulomb_friction:
                # None follows later changes of the Coulomb friction, which would otherwise add stiction.
                changes[place] = None
        if changes:
            for name, part in zip(("values", "joints"), self._changed(changes), strict=True):
                object.__setattr__(self, name, part)
        for joint, own in zip(self.mechanism.joints, self.joints, strict=True):
            self._check_joint(joint, own)
        if len({actuator.motor is None for actuator in self.actuators}) > 1:
            raise ParameterError(
                f"some actuators of plant {self.name!r} have a motor, and others none; expected all of them in volts, "
                "or none"
            )
        if self.is_pendulum:
            vars(self).update(self.numbers)
        else:
            _require_rigid(self)
            self._check_mass()

    def _check_joint(self, joint: Joint, own: JointParameters) -> None:
        where = f"{joint.name}: " if len(self.joints) > 1 else ""
        if own.breakaway < own.coulomb_friction:
            unit = joint.effort_unit
            raise ParameterError(
                f"{where}static_friction is {own.static_friction} {unit}; "
                f"expected >= coulomb_friction = {own.coulomb_friction} {unit}"
            )
        low, high = own.lower_stop, own.upper_stop
        if low is not None and high is not None and not low < high:
            raise ParameterError(f"{where}lower_stop is {low} {joint.unit}; expected < upper_stop = {high}")
        motor = None if own.actuator is None else own.actuator.motor
        if motor is not None and not motor.dead_band < motor.voltage_limit:
            raise ParameterError(
                f"{where}dead_band is {motor.dead_band} V; expected < voltage_limit = {motor.voltage_limit} V"
            )

    def _check_mass(self) -> None:
        turns = [2.0 * math.pi * index / _ANGLES for index in range(_ANGLES)]
        for q in product(*((turns if joint.turns else [0.0]) for joint in self.mechanism.joints)):
            rows = self.mechanism.mass(q, self.packed)
            if self.coordinates.volts:
                self._check_inductance(rows)
            if not _positive_definite(rows):
                at = ", ".join(
                    f"{joint.name} = {value:.3g} {joint.unit}"
                    for joint, value in zip(self.mechanism.joints, q, strict=True)
                )
                raise ParameterError(
                    f"the masses and inertias of {self.name!r} give no positive inertia at {at}; expected an inertia "
                    "about the joint that its mass and centre can have, at least mass * centre^2"
                )

    def _check_inductance(self, mass: Sequence[Sequence[float]]) -> None:
        for index, (name, own) in enumerate(zip(self.coordinates.names, self.joints, strict=True)):
            motor = None if own.actuator is None else own.actuator.motor
            if motor is not None and motor.inductance * motor.damping > _LATE * mass[index][index] * motor.resistance:
                most = _LATE * mass[index][index] * motor.resistance / motor.damping
                raise ParameterError(
                    f"{name}: inductance is {motor.inductance} H; expected at most {most:.3g} H for this inertia and "
                    "back EMF, which the equation applies without lag"
                )

    @cached_property
    def is_pendulum(self) -> bool:
        """Whether it is one hinge, driven by a torque, without end stops."""
        own = self.joints[0]
        return (
            self.mechanism.model == _PENDULUM.name
            and own.actuator is not None
            and own.actuator.motor is None
            and own.lower_stop is own.upper_stop is None
        )

    @property
    def drivetrain(self) -> SeriesElasticParameters | None:
        """Motor, gears and spring of a series-elastic pendulum."""
        return self.joints[0].drivetrain

    @cached_property
    def coordinates(self) -> Coordinates:
        """Joints, and which of them are driven."""
        driven = tuple(index for index, joint in enumerate(self.joints) if joint.actuator is not None)
        return Coordinates(self.mechanism.joints, driven, volts=any(own.motor is not None for own in self.actuators))

    @cached_property
    def packed(self) -> Vector:
        """The mechanism's ``p``: values, dampings of the joints with back EMF, and joint torques if it has any."""
        p = (*self.values, *(joint.total_damping for joint in self.joints))
        return (*p, *(value for own in self.joints for value in own.torques)) if self.has_torques else p

    @property
    def has_torques(self) -> bool:
        """Whether a joint has quadratic drag or a periodic torque."""
        return self.mechanism.name != self.mechanism.model

    @cached_property
    def torque_plant(self) -> PlantParameters:
        """The plant behind its motors, driven by their efforts at standstill; itself if it has no motor.

        Its damping includes the back EMF. :attr:`gains`, or with dead bands :meth:`stall_efforts`, convert commands.
        """
        if not self.coordinates.volts:
            return self
        joints = [
            own if own.actuator is None else replace(
                own, damping=own.total_damping, actuator=replace(own.actuator, motor=None)
            )
            for own in self.joints
        ]  # fmt: skip
        return PlantParameters(self.mechanism, self.values, tuple(joints), self.name)

    def with_motors(self, of: PlantParameters) -> PlantParameters:
        """Return the plant in volts whose :attr:`torque_plant` this is, by the motors of another.

        Raises:
            ParameterError: A joint's damping is less than the back EMF of its motor.
        """
        joints = []
        for name, own, theirs in zip(self.coordinates.names, self.joints, of.joints, strict=True):
            motor = None if theirs.actuator is None else theirs.actuator.motor
            if theirs.actuator is None or motor is None or own.actuator is None:
                joints.append(own)
                continue
            if own.damping < motor.damping:
                raise ParameterError(
                    f"{name}.damping is {own.damping:.4g}; expected at least {motor.damping:.4g}, the back EMF of its "
                    "motor: is the motor another?"
                )
            actuator = replace(theirs.actuator, transport_delay=own.actuator.transport_delay)
            joints.append(replace(own, damping=own.damping - motor.damping, actuator=actuator))
        return PlantParameters(self.mechanism, self.values, tuple(joints), self.name)

    @cached_property
    def gains(self) -> Vector:
        """Effort per command of each driven joint, without dead band: 1, or with a motor [N m/V or N/V]."""
        return tuple(1.0 if own.motor is None else own.motor.gain for own in self.actuators)

    def stall_efforts(self, commands: Sequence[float]) -> Vector:
        """Return the efforts of m commands at standstill [N m or N]."""
        return tuple(
            command if own.motor is None else own.motor.stall_effort(command)
            for own, command in zip(self.actuators, commands, strict=True)
        )

    def voltage_efforts(self, commands: Vector, velocity: Vector) -> Vector:
        """Return the efforts of m commands at n velocities [N m or N]."""
        return self.motor_efforts(self.stall_efforts(commands), velocity)

    def motor_efforts(self, stall: Vector, velocity: Vector) -> Vector:
        """Return m efforts at standstill less those of the back EMF at n velocities [N m or N]."""
        driven = zip(self.actuators, self.coordinates.driven, stall, strict=True)
        return tuple(
            effort if own.motor is None else effort - own.motor.damping * velocity[index]
            for own, index, effort in driven
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Actuators of the driven joints, in order."""
        return tuple(joint.actuator for joint in self.joints if joint.actuator is not None)

    @property
    def effort_limits(self) -> Vector:
        """Largest effort of each driven joint, of a motor at standstill [N m or N]."""
        return tuple(actuator.effort_limit for actuator in self.actuators)

    @property
    def command_limits(self) -> Vector:
        """Largest command of each driven joint, in the coordinates' ``drive_unit``."""
        return tuple(actuator.command_limit for actuator in self.actuators)

    @property
    def weights(self) -> tuple[tuple[float, ...], float]:
        """Default diagonal of Q, and R of the commands: that of the mechanism, for motors per square volt."""
        q, r = self.mechanism.weights
        return (q, r * sum(gain * gain for gain in self.gains) / len(self.gains)) if self.coordinates.volts else (q, r)

    @property
    def stops(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest position of each joint, infinite without a stop [rad or m]."""
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
        strengths = [TERM_PARAMETERS[index] for index in STRENGTHS]
        return any(own.breakaway > 0.0 or any(getattr(own, name) for name in strengths) for own in self.joints)

    @cached_property
    def _places(self) -> dict[str, _Place]:
        return {
            name: place
            for name, place in _places(self.mechanism).items()
            if place.part in {"values", "joint"} or _has(self.joints[place.number].actuator, place)
        }

    def _at(self, place: _Place) -> Any:
        if place.part == "values":
            return self.values[place.number]
        joint = self.joints[place.number]
        if place.part == "motor":
            return getattr(joint.actuator and joint.actuator.motor, place.key)
        return getattr(joint if place.part == "joint" else joint.actuator, place.key)

    def _changed(self, changes: Mapping[_Place, Any]) -> tuple[Vector, tuple[JointParameters, ...]]:
        values, joints = list(self.values), list(self.joints)
        for place, value in changes.items():
            if place.part == "values":
                values[place.number] = value
                continue
            own, change = joints[place.number], {place.key: value}
            if place.part != "joint":
                assert own.actuator is not None
                if place.part == "motor":
                    motor = own.actuator.motor
                    assert motor is not None
                    stale = {"time_constant": 0.0} if motor.inductance > 0.0 else {}
                    change = {**stale, "motor": replace(motor, **change)}
                change = {"actuator": replace(own.actuator, **change)}
            joints[place.number] = replace(own, **change)
        return tuple(values), tuple(joints)

    @property
    def specs(self) -> dict[str, ParameterSpec]:
        """Table of the names that :meth:`with_values` takes."""
        return {name: place.spec for name, place in self._places.items()}

    @cached_property
    def numbers(self) -> dict[str, float]:
        """All given values by the names of :attr:`specs`, of a pendulum all that a file may give."""
        found = {name: self._at(place) for name, place in self._places.items()}
        if self.is_pendulum:
            found["static_friction"] = self.joints[0].breakaway
        return {name: value for name, value in found.items() if value is not None}

    def value(self, name: str) -> float:
        """Return a value by a name of :attr:`specs`; raise a ParameterError if it is unknown or not given."""
        if (key := self._plain(name)) not in self.numbers:
            raise ParameterError(f"{name!r} is not given for plant {self.name!r}; expected {self._expected_names()}")
        return self.numbers[key]

    def with_values(self, changes: Mapping[str, Any] | None = None, /, **more: Any) -> PlantParameters:
        """Return a checked copy with changed values: ``mass_1``, ``elbow.damping``, ``elbow.effort_limit``.

        ``name`` and, of a pendulum, ``drivetrain`` change too.

        Raises:
            ParameterError: A name is unknown, a joint is passive, or a value is outside its domain.
        """
        wanted = {self._plain(name): value for name, value in {**(changes or {}), **more}.items()}
        name = wanted.pop("name", self.name)
        drivetrain = wanted.pop("drivetrain", self.drivetrain)
        for unknown in [key for key in wanted if key not in self._places]:
            raise ParameterError(f"unknown parameter {unknown!r}; expected {self._expected_names()}")
        values, joints = self._changed({self._places[key]: value for key, value in wanted.items()})
        if drivetrain is not self.drivetrain:
            joints = (replace(joints[0], drivetrain=drivetrain), *joints[1:])
        return PlantParameters(self.mechanism, values, joints, name)

    def check_start(self, position: Sequence[float]) -> Vector:
        """Return n start positions as floats [rad or m].

        Raises:
            ParameterError: Their number is wrong, or one is not finite or beyond an end stop.
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
        """Return q'' for n positions, velocities and forces of all joints, without dry friction [rad/s^2 or m/s^2]."""
        result: Vector = self.mechanism.forward(position, velocity, torque, self.packed)
        return result

    def energy(self, position: Vector, velocity: Vector) -> float:
        """Return kinetic and potential energy, 0 at rest hanging down [J]."""
        rows = self.mechanism.mass(position, self.packed)
        kinetic = sum(
            a * m * b for a, row in zip(velocity, rows, strict=True) for m, b in zip(row, velocity, strict=True)
        )
        return float(0.5 * kinetic + self.mechanism.potential(position, self.packed))

    def _plain(self, name: str) -> str:
        """Return a name as in :attr:`specs`: of one joint, ``pendulum_joint.damping`` is ``damping``."""
        joint, _, key = name.partition(".")
        return _name(self.mechanism, self.mechanism.joints[0], key) if [joint] == [*self.coordinates.names] else name

    def _expected_names(self) -> str:
        if len(self.joints) == 1:
            return f"one of {', '.join(self.specs)}"
        own = ", ".join(spec.name for spec in self.mechanism.parameters)
        joints = " or ".join(self.coordinates.names)
        return f"one of {own}, or JOINT.damping and the like with JOINT {joints}"


def _has(actuator: Actuator | None, place: _Place) -> bool:
    """Return whether an actuator has a number of its own; a motor determines effort limit and perhaps time constant."""
    if actuator is None or actuator.motor is None:
        return actuator is not None and place.part == "actuator"
    return place.part == "motor" or place.key not in _determined(actuator.motor)


def _determined(motor: Motor) -> tuple[str, ...]:
    return ("effort_limit", "time_constant") if motor.inductance > 0.0 else ("effort_limit",)


def pendulum_plant(
    inertia: float,
    damping: float,
    gravity: float,
    *,
    drivetrain: SeriesElasticParameters | None = None,
    name: str = "unnamed",
    **numbers: float | None,
) -> PlantParameters:
    """Return a pendulum of M_c [kg m^2], b_c [N m s/rad] and G_c = m g l_c [N m].

    ``numbers`` are others of ``PLANT_SPECS``, else at their defaults; the static friction is then the Coulomb friction.

    Raises:
        ParameterError: A name is unknown, or a value is outside its domain.
    """
    parts: dict[str, dict[str, Any]] = {"joint": {}, "actuator": {"effort_limit": _EXAMPLES["effort_limit"]}}
    for key, value in numbers.items():
        place = _places(_PENDULUM).get(key)
        if place is None:
            expected = ", ".join(spec.name for spec in PLANT_SPECS)
            raise ParameterError(f"unknown parameter {key!r}; expected one of {expected}")
        parts[place.part][place.key] = value
    actuator = Actuator(**parts["actuator"])
    joint = JointParameters(**parts["joint"], damping=damping, actuator=actuator, drivetrain=drivetrain)
    return PlantParameters(_PENDULUM, (inertia, gravity), (joint,), name)


def load_mechanism(preset_or_path: str | Path) -> PlantParameters:
    """Return the plant of a preset or a plant file.

    Raises:
        ParameterError: It does not exist, or is refused; the message names file and entry.
    """
    return load_plant_file(preset_or_path)[0]


def load_plant_file(preset_or_path: str | Path) -> tuple[PlantParameters, dict[str, Any]]:
    """Return the plant and its provenance, with ``intervals``; errors as :func:`load_mechanism`."""
    path = resolve_plant(preset_or_path)
    plant, provenance = _read_file(path, read_text(path, "plant file"))
    return plant, deepcopy(provenance)


@lru_cache(maxsize=64)
def _read_file(path: Path, text: str) -> tuple[PlantParameters, dict[str, Any]]:
    """Return plant and provenance of a file with this text; a command loads its plant many times."""
    document = parse_yaml(text, path, "plant file")
    if document.get("format") == SEALED_FORMAT:
        raise ParameterError(
            f"plant file {path} is sealed for an exercise, and only a simulator runs it; "
            "expected a plant that you identified"
        )
    return read_plant_document(document, path)


def load_plant(preset_or_path: str | Path) -> PlantParameters:
    """Return the pendulum of a preset (one of ``PRESETS``) or a plant file; another mechanism is a ParameterError."""
    parameters = load_mechanism(preset_or_path)
    if not parameters.is_pendulum:
        raise ParameterError(
            f"plant file {resolve_plant(preset_or_path)} describes a mechanism ({parameters.mechanism.model}); "
            f"expected a plant of one joint here, as {PRESET_NAMES}"
        )
    return parameters


def read_plant_document(document: Mapping[str, Any], path: Path) -> tuple[PlantParameters, dict[str, Any]]:
    """Return plant and provenance of a plant file's content; errors as :func:`load_mechanism`."""
    where = str(path)
    if document.get("format") not in (FORMAT, MECHANISM_FORMAT):
        raise ParameterError(
            f"{where}: format is {document.get('format')!r}; expected {FORMAT!r} or {MECHANISM_FORMAT!r}"
        )
    read = _read_pendulum if document["format"] == FORMAT else _read_mechanism
    make, parts, intervals = read(document, where)
    parameters = build_plant(make, {**parts, "name": read_name(document, path)}, where)
    return parameters, read_provenance(document, where, intervals)


_Parts = tuple[Callable[..., PlantParameters], dict[str, Any], dict[str, list[float]]]


def _read_pendulum(document: Mapping[str, Any], where: str) -> _Parts:
    reject_unknown(document, ("format", "name", "parameters", "drivetrain", "provenance"), where=where)
    if "parameters" not in document:
        names = ", ".join(spec.name for spec in PLANT_SPECS)
        raise ParameterError(f"{where}: parameters is missing; expected a mapping of {names}")
    parts: dict[str, Any]
    parts, intervals = read_quantities(document["parameters"], PLANT_SPECS, f"{where}: parameters")
    _require_values(parts, [_places(_PENDULUM)[name].spec for name in _REQUIRED], where)
    if document.get("drivetrain") is not None:
        values, more = read_quantities(document["drivetrain"], DRIVETRAIN_SPECS, f"{where}: drivetrain")
        intervals |= {f"drivetrain.{name}": interval for name, interval in more.items()}
        parts["drivetrain"] = build_plant(SeriesElasticParameters, values, where)
    return pendulum_plant, parts, intervals


def _read_mechanism(document: Mapping[str, Any], where: str) -> _Parts:
    reject_unknown(document, ("format", "name", "model", "parameters", "joints", "provenance"), where=where)
    model = document.get("model")
    # Lists and mappings are not hashable.
    if not isinstance(model, str) or model not in MECHANISMS:
        given = "missing" if model is None else repr(model)
        raise ParameterError(f"{where}: model is {given}; {suggestion(model, MECHANISMS)}")
    mechanism = MECHANISMS[model]
    given_values, intervals = read_quantities(
        document.get("parameters") or {}, mechanism.parameters, f"{where}: parameters"
    )
    # Only these have natural defaults.
    natural = {"gravity", "rotor_inertia", "gear_ratio"}
    _require_values(given_values, [spec for spec in mechanism.parameters if spec.name not in natural], where)
    defaults: dict[str, Any] = {spec.name: spec.default for spec in mechanism.parameters}
    values = tuple({**defaults, **given_values}.values())
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
        own, more = _read_joint(joint, entries[joint.name], f"{where}: joints.{joint.name}")
        joints.append(own)
        intervals |= {_name(mechanism, joint, key): interval for key, interval in more.items()}
    return PlantParameters, {"mechanism": mechanism, "values": values, "joints": tuple(joints)}, intervals


def _require_values(values: Mapping[str, float], specs: Sequence[ParameterSpec], where: str) -> None:
    for spec in specs:
        if spec.name not in values:
            raise ParameterError(f"{where}: parameters.{spec.name} is missing; expected a value in {spec.unit}")


def _read_joint(joint: Joint, entry: object, where: str) -> tuple[JointParameters, dict[str, list[float]]]:
    content = dict(require_mapping(entry if entry is not None else {}, where))
    has_actuator = "actuator" in content
    block = content.pop("actuator", None)
    specs = _format_2(joint)
    reject_unknown(content, (*(spec.name for spec in specs), "actuator"), where=where)
    values, intervals = read_quantities(content, specs, where)
    parts: dict[str, Any] = {**values}
    if has_actuator:
        where = f"{where}.actuator"
        drive: dict[str, Any]
        entries = dict(require_mapping(block, where))
        of_motor = entries.pop("motor", None)
        drive, more = read_quantities(entries, actuator_specs(joint), where)
        intervals.update(more)
        if of_motor is not None:
            numbers, more = read_quantities(of_motor, motor_specs(joint), f"{where}.motor")
            intervals.update(more)
            drive = {**drive, "motor": _read_motor(joint, numbers, drive, where)}
        elif "effort_limit" not in drive:
            raise ParameterError(
                f"{where}.effort_limit is missing; expected a value in {joint.effort_unit}, or a motor for commands in "
                "volts"
            )
        parts["actuator"] = Actuator(**{"effort_limit": math.inf, **drive})
    return JointParameters(**parts), intervals


def _read_motor(joint: Joint, numbers: dict[str, float], beside: Mapping[str, float], where: str) -> Motor:
    for spec in motor_specs(joint)[:3]:
        if spec.name not in numbers:
            raise ParameterError(f"{where}.motor.{spec.name} is missing; expected a value in {spec.unit}")
    motor = Motor(**numbers)
    for name in _determined(motor):
        if name in beside:
            by = "voltage_limit" if name == "effort_limit" else "inductance / resistance"
            raise ParameterError(f"{where}.{name} is given beside a motor; expected it left out: {by} is in its place")
    return motor


def write_plant(
    path: str | Path,
    parameters: PlantParameters,
    *,
    provenance: Mapping[str, Any] | None = None,
    intervals: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Write a plant file atomically, with plain provenance and 95 % intervals by name (``elbow.damping``).

    Raises:
        ParameterError: The file cannot be written.
    """
    path = Path(path)
    document = plant_document(parameters, intervals)
    text = dump_yaml({**document, "provenance": dict(provenance)} if provenance else document, f"plant file {path}")
    with writing(f"plant file {path}", ParameterError):
        write_atomically(path, text)
    return path


def plant_document(
    parameters: PlantParameters, intervals: Mapping[str, Sequence[float]] | None = None
) -> dict[str, Any]:
    """Return the content of a plant file, each value with its unit and, if given, its interval."""
    known = intervals or {}
    mechanism, drive = parameters.mechanism, parameters.drivetrain
    document: dict[str, Any] = {"format": FORMAT, "name": parameters.name}
    if parameters.is_pendulum:
        document["parameters"] = write_quantities(parameters.numbers, PLANT_SPECS, known)
        if drive is not None:
            document["drivetrain"] = write_quantities(vars(drive), DRIVETRAIN_SPECS, {})
        return document
    joints: dict[str, Any] = {}
    for joint, own in zip(mechanism.joints, parameters.joints, strict=True):
        specs, drives, motors = _format_2(joint), actuator_specs(joint), motor_specs(joint)
        names = {spec.name: _name(mechanism, joint, spec.name) for spec in (*specs, *drives, *motors)}
        of_joint = {key: known[name] for key, name in names.items() if name in known}
        joints[joint.name] = write_quantities(vars(own), specs, of_joint)
        if own.actuator is not None:
            entry: dict[str, Any] = {}
            if (motor := own.actuator.motor) is not None:
                drives = tuple(spec for spec in drives if spec.name not in _determined(motor))
                entry["motor"] = write_quantities(vars(motor), motors, of_joint)
            joints[joint.name]["actuator"] = {**write_quantities(vars(own.actuator), drives, of_joint), **entry}
    own_values = write_quantities(parameters.numbers, mechanism.parameters, known)
    return {
        **document, "format": MECHANISM_FORMAT, "model": mechanism.model, "parameters": own_values, "joints": joints
    }  # fmt: skip


def resolve_plant(preset_or_path: str | Path) -> Path:
    """Return the file of a preset, or the path itself; raise a ParameterError for an unknown name."""
    text = str(preset_or_path)
    if text in PRESETS or text in MECHANISM_PRESETS:
        return _PRESET_FOLDER / f"{text}.yaml"
    path = Path(text).expanduser()
    if not path.exists() and "/" not in text and path.suffix == "":
        raise ParameterError(
            f"plant is {text!r}; expected one of the presets {PRESET_NAMES} (one joint), "
            f"{', '.join(MECHANISM_PRESETS)} (several) or the path of a plant file"
        )
    return path


def is_mechanism(preset_or_path: str | Path) -> bool:
    """Return whether a preset or plant file is no pendulum; a sealed one is a pendulum."""
    path = resolve_plant(preset_or_path)
    return _is_mechanism(path, read_text(path, "plant file"))


@lru_cache(maxsize=64)
def _is_mechanism(path: Path, text: str) -> bool:
    document = parse_yaml(text, path, "plant file")
    return document.get("format") == MECHANISM_FORMAT and not _read_file(path, text)[0].is_pendulum


def require_one_joint(preset_or_path: str | Path, instead: str) -> None:
    """Raise a ParameterError for a plant of several joints; the message says what to use instead."""
    if is_mechanism(preset_or_path):
        several = len(load_mechanism(preset_or_path).joints) > 1
        has = "several joints" if several else "a motor in volts, or end stops"
        raise ParameterError(f"plant is {preset_or_path}, which has {has}; expected one of one joint, or {instead}")


def _positive_definite(rows: Sequence[Sequence[float]]) -> bool:
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


def pack_joints(parameters: PlantParameters) -> JointTable:
    """Return friction, stops and lags of the joints in the order of ``JOINT_ROWS``.

    Raises:
        ParameterError: The plant has a drivetrain, an offset or a further friction term, which the steps do not
            support, or a motor: they take its ``torque_plant``.
    """
    _require_rigid(parameters)
    if parameters.coordinates.volts:
        raise ParameterError(
            f"plant {parameters.name!r} is driven in volts; expected one that is driven by an effort, without a motor"
        )
    joints = parameters.joints
    return (
        tuple(joint.coulomb_friction for joint in joints),
        tuple(joint.breakaway for joint in joints),
        tuple(joint.stribeck_velocity for joint in joints),
        tuple(-FAR if joint.lower_stop is None else joint.lower_stop for joint in joints),
        tuple(FAR if joint.upper_stop is None else joint.upper_stop for joint in joints),
        tuple(0.0 if joint.actuator is None else joint.actuator.time_constant for joint in joints),
    )


def common_delay(parameters: PlantParameters) -> float:
    """Return the common transport delay of all actuators [s]; raise a ParameterError if they differ."""
    delays = {actuator.transport_delay for actuator in parameters.actuators}
    if len(delays) > 1:
        raise ParameterError(
            f"transport_delay is {' and '.join(f'{delay} s' for delay in sorted(delays))} on plant "
            f"{parameters.name!r}; expected the same for all actuators"
        )
    return delays.pop() if delays else 0.0


def _require_rigid(parameters: PlantParameters) -> None:
    name = parameters.name
    if any(own.drivetrain is not None for own in parameters.joints):
        raise ParameterError(f"plant {name!r} is series elastic; expected a rigid one for the equations of any joints")
    for joint, own in zip(parameters.mechanism.joints, parameters.joints, strict=True):
        for spec in joint_specs(joint):
            value = getattr(own, spec.name)
            if spec.name in OF_A_PENDULUM and value != spec.default:
                given = f"{value} {spec.unit}".removesuffix(" -")
                raise ParameterError(
                    f"{spec.name} of plant {name!r} is {given}; expected {spec.default:g} for the equations of any "
                    "joints"
                )
