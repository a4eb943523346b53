"""The plants of a result: results are combined only for the same simulation and hardware."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["IDENTITY", "UNKNOWN", "Case", "identity_of", "plant_identity"]

IDENTITY = "identity"
"""Entry of a run's record: the plant that ran, by name and a hash of all of its values."""


def identity_of(name: str, *content: Any) -> str:
    """Return a name with a short hash of content: JSON values, and paths of files, which count by their bytes."""
    parts = [
        hashlib.sha256(one.read_bytes()).hexdigest() if isinstance(one, Path) else one
        for one in content
        if not isinstance(one, Path) or one.is_file()
    ]
    return f"{name} ({hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]})"


def plant_identity(plant: PlantParameters) -> str:
    """Return the identity of a plant: equal for plants that move alike, independent of the file's name."""
    values = json.loads(describe_plants([plant]))[0]
    return identity_of(str(values.pop("name")), values)


@dataclass(frozen=True)
class Case:
    """Identities of the simulation and of the hardware (with the strategy of its drive); empty if not recorded."""

    simulation: str = ""
    hardware: str = ""

    @classmethod
    def of(cls, simulation: Iterable[Mapping[str, Any]], hardware: Iterable[Mapping[str, Any]]) -> Case:
        """Return the case of the records of runs on both sides; a DataError if the runs of a side are of two plants."""
        sides = []
        for side, records in (("simulation", simulation), ("hardware", hardware)):
            found = sorted({str(record[IDENTITY]) for record in records if record.get(IDENTITY)})
            if len(found) > 1:
                raise DataError(f"{side} is {found[0]} in one run and {found[1]} in another; expected one plant")
            sides.append("".join(found))
        return cls(*sides)

    def require_same(self, other: Case, where: str) -> None:
        """Raise a DataError for a result (stored at ``where``) of other plants; unknown identities are not compared."""
        for side, ours in asdict(self).items():
            theirs = getattr(other, side)
            if ours and theirs and ours != theirs:
                raise DataError(f"{where} is of {side} {theirs}; expected that of the compared recordings, {ours}")


UNKNOWN = Case()
"""The plants of a result that does not name them."""
