"""Whether the plant that a controller was designed for is the plant that runs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.plants.joint_parameters import (
    DRIVETRAIN_SPECS,
    OF_A_PENDULUM,
    Actuator,
    JointParameters,
    Motor,
    SeriesElasticParameters,
)
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant

__all__ = [
    "PLANT_PARAMETERS",
    "PlantDifference",
    "describe_plants",
    "plant_differences",
    "plant_mismatch",
    "read_plants",
]

PLANT_PARAMETERS = "plant_parameters"
"""Key of a plant's descriptions in its diagnostics."""
_SAME = 1e-3
"""Relative difference due to fewer printed digits."""


@dataclass(frozen=True)
class PlantDifference:
    """One parameter in which two plants differ, with its unit; ``drivetrain`` where only one plant has one."""

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


def plant_differences(designed: PlantParameters, running: PlantParameters) -> tuple[PlantDifference, ...]:
    """Return the parameters that differ by more than 0.1 %, in the order of the plant file.

    If only one plant has a drivetrain, the links are compared and the drivetrain is named once.
    """
    first, second = (plant.mechanism.model for plant in (designed, running))
    if first != second:
        return (PlantDifference("model", first, second, ""),)
    found = []
    for name in {**designed.numbers, **running.numbers}:
        mine, theirs = designed.numbers.get(name), running.numbers.get(name)
        if mine is None or theirs is None:
            first, second = ("none" if value is None else f"{value:.6g}" for value in (mine, theirs))
            found.append(PlantDifference(name, first, second, ""))
        elif _differ(mine, theirs):
            found.append(PlantDifference(name, mine, theirs, designed.specs[name].unit))
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


def plant_mismatch(designed: PlantParameters, running: Sequence[PlantParameters]) -> str:
    """Return how the running plant differs from the one designed for, or an empty string.

    ``running`` holds alternative descriptions of one plant, such as a machine with its drivetrain and its rigid
    equivalent: one match suffices, else the closest is reported. Empty means unknown.
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


def describe_plants(plants: Sequence[PlantParameters]) -> str:
    """Return descriptions of a plant as text for its diagnostics."""
    return json.dumps([_as_mapping(plant) for plant in plants], separators=(",", ":"))


def read_plants(text: str) -> tuple[PlantParameters, ...]:
    """Return the plants of :func:`describe_plants`; raise a ParameterError for other text or values."""
    try:
        return tuple(_from_mapping(entry) for entry in json.loads(text))
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise ParameterError(f"{PLANT_PARAMETERS} is no description of plants: {error}") from error


def _as_mapping(plant: PlantParameters) -> dict[str, Any]:
    if plant.is_pendulum:
        drive = {} if plant.drivetrain is None else {"drivetrain": vars(plant.drivetrain)}
        return {"name": plant.name, **plant.numbers, **drive}
    joints = [
        {key: value for key, value in asdict(joint).items() if key not in {*OF_A_PENDULUM, "drivetrain"}}
        for joint in plant.joints
    ]
    return {"name": plant.name, "model": plant.mechanism.model, "values": list(plant.values), "joints": joints}


def _from_mapping(entry: Any) -> PlantParameters:
    name = str(entry.get("name", "unnamed"))
    if "model" not in entry:
        drive = entry.get("drivetrain")
        built = None if drive is None else SeriesElasticParameters(**drive)
        return pendulum_plant(**{**entry, "drivetrain": built, "name": name})
    joints = []
    for joint in entry["joints"]:
        drive = joint.get("actuator")
        if drive is not None:
            motor = drive.get("motor")
            drive = Actuator(**{**drive, "motor": None if motor is None else Motor(**motor)})
        joints.append(JointParameters(**{**joint, "actuator": drive}))
    return PlantParameters(MECHANISMS[entry["model"]], tuple(entry["values"]), tuple(joints), name)


def _differ(designed: float, running: float) -> bool:
    return not math.isclose(designed, running, rel_tol=_SAME)
