"""Whether the plant that a controller was designed for is the plant that runs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.plants.joint_parameters import Actuator, JointParameters
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism
from pendulum_msgs_py.plants.plant_parameters import (
    DRIVETRAIN_SPECS,
    PLANT_SPECS,
    PlantParameters,
    SeriesElasticParameters,
    is_mechanism,
    load_plant,
)

__all__ = [
    "PLANT_PARAMETERS",
    "AnyPlant",
    "PlantDifference",
    "describe_plants",
    "load_any_plant",
    "plant_differences",
    "plant_mismatch",
    "read_plants",
]

PLANT_PARAMETERS = "plant_parameters"
"""Key of a plant's description in its diagnostics."""
_SAME = 1e-3
"""Relative difference of a value up to which it is the same, written with fewer digits."""


@dataclass(frozen=True)
class PlantDifference:
    """One parameter in which two plants differ.

    Attributes:
        name: The parameter; ``drivetrain`` where one plant has a motor and a spring and the other has not.
        designed: Its value in the plant designed for.
        running: Its value in the plant that runs.
        unit: Unit of both; empty for ``drivetrain``.
    """

    name: str
    designed: float | str
    running: float | str
    unit: str

    def __str__(self) -> str:
        """Return the difference as text, the plant designed for first."""
        first, second = (
            f"{value:.6g}" if isinstance(value, float) else value for value in (self.designed, self.running)
        )
        unit = f" {self.unit}" if self.unit not in {"", "-"} else ""
        return f"{self.name} {first}, runs {second}{unit}"


AnyPlant = PlantParameters | MechanismParameters


def load_any_plant(preset_or_path: str) -> AnyPlant:
    """Return the plant of a preset or a file, of one joint or several.

    Raises:
        ParameterError: It cannot be read.
    """
    return load_mechanism(preset_or_path) if is_mechanism(preset_or_path) else load_plant(preset_or_path)


def plant_differences(designed: AnyPlant, running: AnyPlant) -> tuple[PlantDifference, ...]:
    """Return the parameters in which two plants differ, in the order of the plant file.

    Values within 0.1 % of each other count as the same. Of a rigid plant and a series-elastic one the link is compared,
    and the drivetrain named once.
    """
    if not (isinstance(designed, PlantParameters) and isinstance(running, PlantParameters)):
        return _joint_differences(designed, running)
    found = [
        PlantDifference(spec.name, *values, spec.unit)
        for spec in PLANT_SPECS
        if _differ(*(values := (getattr(designed, spec.name), getattr(running, spec.name))))
    ]
    drives = designed.drivetrain, running.drivetrain
    if (drives[0] is None) != (drives[1] is None):
        first, second = ("rigid" if drive is None else "series elastic" for drive in drives)
        found.append(PlantDifference("drivetrain", first, second, ""))
    elif drives[0] is not None:
        found += [
            PlantDifference(f"drivetrain.{spec.name}", *values, spec.unit)
            for spec in DRIVETRAIN_SPECS
            if _differ(*(values := (getattr(drives[0], spec.name), getattr(drives[1], spec.name))))
        ]
    return tuple(found)


def _joint_differences(designed: AnyPlant, running: AnyPlant) -> tuple[PlantDifference, ...]:
    first, second = (
        plant.mechanism.name if isinstance(plant, MechanismParameters) else "pendulum" for plant in (designed, running)
    )
    if first != second or not (isinstance(designed, MechanismParameters) and isinstance(running, MechanismParameters)):
        return (PlantDifference("model", first, second, ""),)
    found = []
    for name in {**designed.numbers, **running.numbers}:
        mine, theirs = designed.numbers.get(name), running.numbers.get(name)
        if mine is None or theirs is None:
            first, second = ("none" if value is None else f"{value:.6g}" for value in (mine, theirs))
            found.append(PlantDifference(name, first, second, ""))
        elif _differ(mine, theirs):
            found.append(PlantDifference(name, mine, theirs, designed.specs[name].unit))
    return tuple(found)


def plant_mismatch(designed: AnyPlant, running: Sequence[AnyPlant]) -> str:
    """Return as text how the running plant differs from the one designed for; empty where it does not.

    Args:
        designed: The plant designed for.
        running: Descriptions of the one plant that runs, such as a machine with its drivetrain and the rigid plant
            that experiments on it give; one match is enough, else the closest is reported. Empty: nothing is known.
    """
    if not running:
        return ""
    compared = [(plant, plant_differences(designed, plant)) for plant in running]
    closest, differences = min(compared, key=lambda pair: len(pair[1]))
    if not differences:
        return ""
    return (
        f"designed for plant {designed.name!r}, but {closest.name!r} runs: designed for "
        f"{'; '.join(str(each) for each in differences)}"
    )


def describe_plants(plants: Sequence[AnyPlant]) -> str:
    """Return a plant's descriptions, one or several, as text for its diagnostics."""
    return json.dumps([_as_mapping(plant) for plant in plants], separators=(",", ":"))


def read_plants(text: str) -> tuple[AnyPlant, ...]:
    """Return the plants of a text that :func:`describe_plants` wrote.

    Raises:
        ParameterError: The text is something else, or a value is outside of its domain.
    """
    try:
        return tuple(_from_mapping(entry) for entry in json.loads(text))
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise ParameterError(f"{PLANT_PARAMETERS} is no description of plants: {error}") from error


def _as_mapping(plant: AnyPlant) -> dict[str, Any]:
    if isinstance(plant, MechanismParameters):
        joints = [asdict(joint) for joint in plant.joints]
        return {"name": plant.name, "model": plant.mechanism.name, "values": list(plant.values), "joints": joints}
    drive = plant.drivetrain
    values: dict[str, Any] = {"name": plant.name, **{spec.name: getattr(plant, spec.name) for spec in PLANT_SPECS}}
    if drive is not None:
        values["drivetrain"] = {each.name: getattr(drive, each.name) for each in fields(drive)}
    return values


def _from_mapping(entry: Any) -> AnyPlant:
    if "model" in entry:
        joints = []
        for joint in entry["joints"]:
            drive = joint.get("actuator")
            joints.append(JointParameters(**{**joint, "actuator": None if drive is None else Actuator(**drive)}))
        values = tuple(float(value) for value in entry["values"])
        return MechanismParameters(MECHANISMS[entry["model"]], values, tuple(joints), str(entry.get("name", "unnamed")))
    drive = entry.get("drivetrain")
    built = None if drive is None else SeriesElasticParameters(**drive)
    return PlantParameters(**{**entry, "drivetrain": built, "name": str(entry.get("name", "unnamed"))})


def _differ(designed: float, running: float) -> bool:
    return not math.isclose(designed, running, rel_tol=_SAME)
