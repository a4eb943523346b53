"""Physical parameters of a pendulum: one dataclass, one YAML format, shared by plant, design and identification.

The file gives each value with its unit, so that a file in other units is refused rather than misread::

    format: pendulum_plant/1
    name: thesis
    parameters:
      inertia: {value: 0.055, unit: kg m^2}
      damping: {value: 11.77, unit: N m s/rad, interval: [11.70, 11.84]}
      gravity: {value: 1.678, unit: N m}
    drivetrain: {...}      # only for a series-elastic plant
    provenance: {...}      # optional: data, method, date
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates, Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import dump_yaml, load_yaml, reject_unknown
from pendulum_msgs_py.plants.friction_terms import term_fields
from pendulum_msgs_py.plants.quantities import (
    Quantity,
    build_plant,
    check_fields,
    read_name,
    read_provenance,
    read_quantities,
    specs_of,
    write_quantities,
)
from pendulum_msgs_py.whole_file import write_whole, writing

__all__ = [
    "DRIVETRAIN_SPECS",
    "FORMAT",
    "MECHANISM_FORMAT",
    "MECHANISM_PRESETS",
    "PLANT_SPECS",
    "PRESETS",
    "PRESET_NAMES",
    "SEALED_FORMAT",
    "SERIES_ELASTIC_PRESETS",
    "PlantParameters",
    "SeriesElasticParameters",
    "is_mechanism",
    "load_plant",
    "load_plant_file",
    "plant_document",
    "read_plant_document",
    "require_one_joint",
    "resolve_plant",
    "save_document",
    "write_plant",
]

FORMAT = "pendulum_plant/1"
MECHANISM_FORMAT = "pendulum_plant/2"
"""Format of a plant file of several joints; see :mod:`pendulum_msgs_py.plants.mechanism_parameters`."""
SEALED_FORMAT = "pendulum_plant_sealed/1"
"""Format of a plant file that only simulators read; see :mod:`pendulum_msgs_py.plants.sealed_plant`."""
_PRESET_FOLDER = Path(str(resources.files("pendulum_msgs_py.plants") / "presets"))
_PRESET_TEXTS = {
    file.stem: file.read_text(encoding="utf-8")
    for file in sorted(_PRESET_FOLDER.glob("*.yaml"), key=lambda file: (file.stem != "thesis", file.stem))
}
MECHANISM_PRESETS = tuple(
    name for name, text in _PRESET_TEXTS.items() if f"\nformat: {MECHANISM_FORMAT}" in f"\n{text}"
)
"""Names of the plant files of several joints that come with the package."""
PRESETS = tuple(name for name in _PRESET_TEXTS if name not in MECHANISM_PRESETS)
"""Names of the plant files of one joint; a file in their folder is a preset, the default comes first."""
PRESET_NAMES = ", ".join(PRESETS)
"""The same for help texts."""
SERIES_ELASTIC_PRESETS = tuple(name for name in PRESETS if "\ndrivetrain:" in _PRESET_TEXTS[name])
"""Those of them that have motor, gears and spring."""


@dataclass(frozen=True)
class SeriesElasticParameters:
    """Motor, gear train and spring of a series-elastic actuator.

    Source: HEBI X5-9 datasheet values; friction and hysteresis from public logs of X5 actuators.
    """

    gear_ratio: Annotated[float, Quantity("-", "Motor turns per output turn, N.", positive=True)] = 1742.222
    torque_constant: Annotated[
        float, Quantity("N m/A", "Torque per winding current at the motor, K_t.", positive=True)
    ] = 6.26e-3
    back_emf_constant: Annotated[float, Quantity("V s/rad", "Voltage per motor speed, K_e.")] = 6.241e-3
    winding_resistance: Annotated[
        float, Quantity("ohm", "Winding resistance at 20 degrees Celsius, R.", positive=True)
    ] = 9.99
    winding_temperature: Annotated[float, Quantity("degC", "Winding temperature at the start.", signed=True)] = 22.0
    resistance_temperature_coefficient: Annotated[float, Quantity("1/K", "Relative change of R per kelvin.")] = 0.004
    supply_voltage: Annotated[float, Quantity("V", "Supply voltage, V.", positive=True)] = 36.0
    efficiency: Annotated[
        float, Quantity("-", "Share of motor torque that a command counts on at the output.", positive=True)
    ] = 0.65
    reflected_inertia: Annotated[
        float, Quantity("kg m^2", "Rotor inertia seen at the output, J_r N^2.", positive=True)
    ] = 0.19
    motor_damping: Annotated[
        float, Quantity("N m s/rad", "Viscous friction of motor and gears at the output, b_v.")
    ] = 1.4
    motor_coulomb_friction: Annotated[
        float, Quantity("N m", "Dry friction of motor and gears at the output, tau_C.")
    ] = 0.3
    motor_static_friction: Annotated[
        float, Quantity("N m", "Dry friction at which the motor starts to slide, tau_S.")
    ] = 0.39
    motor_stribeck_velocity: Annotated[
        float, Quantity("rad/s", "Velocity over which tau_S falls to tau_C.", positive=True)
    ] = 0.01
    stiffness: Annotated[float, Quantity("N m/rad", "Spring stiffness at small deflection, k.", positive=True)] = 100.0
    stiffness_hardening: Annotated[
        float, Quantity("N m/rad^3", "Growth of the stiffness with the deflection squared.")
    ] = 0.0
    hysteresis_torque: Annotated[float, Quantity("N m", "Half width of the spring's hysteresis loop, tau_h.")] = 0.05
    hysteresis_deflection: Annotated[
        float, Quantity("rad", "Deflection over which the loop turns round.", positive=True)
    ] = 2e-4

    def __post_init__(self) -> None:
        """Check every value; a static friction below the sliding one would feed energy in."""
        check_fields(self, DRIVETRAIN_SPECS)
        if self.motor_static_friction < self.motor_coulomb_friction:
            raise ParameterError(
                f"motor_static_friction is {self.motor_static_friction} N m; "
                f"expected >= motor_coulomb_friction = {self.motor_coulomb_friction} N m"
            )


if TYPE_CHECKING:

    @dataclass(frozen=True, kw_only=True)
    class _FrictionTerms:
        """What type checkers see of the terms' parameters: those of the table of terms."""

        load_friction: float = 0.0

else:
    _FrictionTerms = term_fields()


@dataclass(frozen=True)
class PlantParameters(_FrictionTerms):
    """Parameters of M_c theta'' + b_c theta' + friction + G_c sin(theta) = u + d.

    ``static_friction`` may be left out (None) and is then the Coulomb friction. Parameters of
    :mod:`pendulum_msgs_py.plants.friction_terms` are given by name.
    """

    inertia: Annotated[float, Quantity("kg m^2", "Inertia about the joint, M_c.", positive=True, example=0.055)]
    damping: Annotated[float, Quantity("N m s/rad", "Viscous friction, b_c.", example=11.77)]
    gravity: Annotated[
        float, Quantity("N m", "Gravity coefficient, G_c = m g l_c; 0 for a pendulum that lies flat.", example=1.678)
    ]
    coulomb_friction: Annotated[float, Quantity("N m", "Dry friction while sliding fast, tau_C.")] = 0.0
    static_friction: Annotated[float, Quantity("N m", "Dry friction at which sliding starts, tau_S >= tau_C.")] = None  # type: ignore[assignment]  # filled in below
    stribeck_velocity: Annotated[
        float, Quantity("rad/s", "Velocity over which tau_S falls to tau_C.", positive=True)
    ] = 0.01
    torque_offset: Annotated[
        float, Quantity("N m", "Constant torque that the sensor of effort misses.", signed=True)
    ] = 0.0
    angle_offset: Annotated[float, Quantity("rad", "Measured angle when hanging at rest.", signed=True)] = 0.0
    effort_limit: Annotated[float, Quantity("N m", "Largest torque of the actuator.", positive=True)] = 13.0
    actuator_time_constant: Annotated[
        float, Quantity("s", "First-order lag between command and torque; 0 for none.")
    ] = 0.0
    transport_delay: Annotated[float, Quantity("s", "Time between a command and its first effect.")] = 0.0
    drivetrain: SeriesElasticParameters | None = None
    name: str = field(default="unnamed", compare=False)

    def __post_init__(self) -> None:
        """Check every value and fill in the static friction."""
        if self.static_friction is None:
            object.__setattr__(self, "static_friction", self.coulomb_friction)  # type: ignore[unreachable]
        check_fields(self, PLANT_SPECS)
        if self.static_friction < self.coulomb_friction:
            raise ParameterError(
                f"static_friction is {self.static_friction} N m; "
                f"expected >= coulomb_friction = {self.coulomb_friction} N m"
            )

    @property
    def coordinates(self) -> Coordinates:
        """The only joint, which is driven."""
        return ONE_JOINT

    @property
    def effort_limits(self) -> Vector:
        """Largest effort of each driven joint [N m]."""
        return (self.effort_limit,)

    def with_values(self, **changes: Any) -> PlantParameters:
        """Return a copy with some values changed, checked again.

        A static friction equal to the Coulomb friction follows it: otherwise a change would add stiction.
        """
        if "coulomb_friction" in changes and self.static_friction == self.coulomb_friction:
            changes = {"static_friction": None, **changes}
        return replace(self, **changes)


DRIVETRAIN_SPECS = specs_of(SeriesElasticParameters)
"""Quantities of a plant file's section ``drivetrain``."""
PLANT_SPECS = specs_of(PlantParameters)
"""Quantities of a plant file's section ``parameters``."""


def load_plant(preset_or_path: str | Path) -> PlantParameters:
    """Return the parameters of a preset (one of ``PRESETS``) or of a plant file.

    Raises:
        ParameterError: No such preset or file, or the file is refused; the message names file and entry.
    """
    return load_plant_file(preset_or_path)[0]


def load_plant_file(preset_or_path: str | Path) -> tuple[PlantParameters, dict[str, Any]]:
    """Return the parameters and the file's provenance (intervals included under ``intervals``).

    Raises:
        ParameterError: as :func:`load_plant`.
    """
    path = resolve_plant(preset_or_path)
    document = load_yaml(path, "plant file")
    if document.get("format") == SEALED_FORMAT:
        raise ParameterError(
            f"plant file {path} is sealed for an exercise, and only a simulator runs it; "
            "expected a plant that you identified"
        )
    return read_plant_document(document, path)


def read_plant_document(document: Mapping[str, Any], path: Path) -> tuple[PlantParameters, dict[str, Any]]:
    """Return the parameters and the provenance of the content of a plant file.

    Args:
        document: The content.
        path: The file, for messages and as a name.

    Raises:
        ParameterError: as :func:`load_plant`.
    """
    where = str(path)
    if document.get("format") == MECHANISM_FORMAT:
        raise ParameterError(
            f"plant file {path} describes a mechanism ({document.get('model')}); expected a plant of one joint here, "
            f"as {PRESET_NAMES}"
        )
    # What the other names may be depends on the format.
    if document.get("format") != FORMAT:
        raise ParameterError(f"{where}: format is {document.get('format')!r}; expected {FORMAT!r}")
    reject_unknown(document, ("format", "name", "parameters", "drivetrain", "provenance"), where=where)
    if "parameters" not in document:
        names = ", ".join(spec.name for spec in PLANT_SPECS)
        raise ParameterError(f"{where}: parameters is missing; expected a mapping of {names}")
    values, intervals = read_quantities(document["parameters"], PLANT_SPECS, f"{where}: parameters")
    for required in ("inertia", "damping", "gravity"):
        if required not in values:
            unit = next(spec.unit for spec in PLANT_SPECS if spec.name == required)
            raise ParameterError(f"{where}: parameters.{required} is missing; expected a value in {unit}")
    drivetrain = None
    if document.get("drivetrain") is not None:
        drivetrain_values, more = read_quantities(document["drivetrain"], DRIVETRAIN_SPECS, f"{where}: drivetrain")
        intervals.update({f"drivetrain.{name}": interval for name, interval in more.items()})
        drivetrain = build_plant(SeriesElasticParameters, drivetrain_values, where)
    parts = {**values, "drivetrain": drivetrain, "name": read_name(document, path)}
    return build_plant(PlantParameters, parts, where), read_provenance(document, where, intervals)


def write_plant(
    path: str | Path,
    parameters: PlantParameters,
    *,
    provenance: Mapping[str, Any] | None = None,
    intervals: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Write a plant file that :func:`load_plant` reads back to the same values.

    The file appears whole or not at all.

    Args:
        path: Where to write.
        parameters: The values.
        provenance: Data, method, date: plain YAML values.
        intervals: 95 % interval by parameter name, in the parameter's unit.

    Raises:
        ParameterError: The file cannot be written.
    """
    return save_document(path, plant_document(parameters, intervals), provenance)


def save_document(path: str | Path, document: Mapping[str, Any], provenance: Mapping[str, Any] | None) -> Path:
    """Write the content of a plant file, and where it is from; the file appears whole or not at all.

    Raises:
        ParameterError: The file cannot be written.
    """
    path = Path(path)
    whole = {**document, "provenance": dict(provenance)} if provenance else document
    text = dump_yaml(whole, f"plant file {path}")
    with writing(f"plant file {path}", ParameterError):
        write_whole(path, text)
    return path


def plant_document(
    parameters: PlantParameters, intervals: Mapping[str, Sequence[float]] | None = None
) -> dict[str, Any]:
    """Return the content of a plant file with some parameters, each with its unit and, where given, its interval."""
    document: dict[str, Any] = {
        "format": FORMAT,
        "name": parameters.name,
        "parameters": write_quantities(vars(parameters), PLANT_SPECS, intervals or {}),
    }
    if parameters.drivetrain is not None:
        document["drivetrain"] = write_quantities(vars(parameters.drivetrain), DRIVETRAIN_SPECS, {})
    return document


def resolve_plant(preset_or_path: str | Path) -> Path:
    """Return the file of a preset, or the path itself; a word that is neither is refused."""
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
    """Return whether a preset or plant file is one of several joints.

    Raises:
        ParameterError: No such preset or file.
    """
    return load_yaml(resolve_plant(preset_or_path), "plant file").get("format") == MECHANISM_FORMAT


def require_one_joint(preset_or_path: str | Path, instead: str) -> None:
    """Refuse a plant of several joints.

    Args:
        preset_or_path: Preset or plant file.
        instead: What does something like it for several joints, for the message.

    Raises:
        ParameterError: It is one, or there is no such preset or file.
    """
    if is_mechanism(preset_or_path):
        raise ParameterError(
            f"plant is {preset_or_path}, which has several joints; expected one of one joint, or {instead}"
        )
