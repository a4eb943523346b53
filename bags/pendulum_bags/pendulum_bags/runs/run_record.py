"""The run record in a bag: controller, plant, disturbance, seed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["DIFFERENCE", "RUN_RECORD", "SURROGATE", "is_surrogate", "record_named", "run_record"]

RUN_RECORD = "pendulum.run"
"""Name of the record among a bag's metadata; ``RunSpec`` and the settings of experiments write it."""
DIFFERENCE = "difference"
"""Entry of a record's simulation: how it moves otherwise than the equation of the design."""
SURROGATE = "stand_in"
"""Entry of the record for a surrogate of the hardware: ``simulation`` for a second one."""


def run_record(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the record of the run, empty where a bag has none, or something else under that name."""
    return record_named(metadata, RUN_RECORD)


def is_surrogate(record: Mapping[str, Any]) -> bool:
    """Return whether an emulator, or a second simulation, took the place of the hardware in a run."""
    return record.get("plant") == "emulator" or SURROGATE in record


def record_named(metadata: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a record of a bag's metadata by its name, empty where a bag has none or something else there."""
    found = metadata.get(name)
    return found if isinstance(found, Mapping) else {}
