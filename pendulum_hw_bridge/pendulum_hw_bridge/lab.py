"""The lab file as the bridge understands it: each entry checked by the table of the bridge's parameters."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.lab_file import LAB_ENTRIES, load_lab

__all__ = ["LAB_SPEC", "check_lab"]

LAB_SPEC = ParameterSpec(
    "lab_file",
    "",
    "",
    "Lab file: which actuator, how it is mounted, limited, driven and fed; what is given beside it wins.",
    read_only=True,
)
"""Parameter that names the lab file."""


def check_lab(path: str | Path, specs: Iterable[ParameterSpec]) -> dict[str, Any]:
    """Return the values of a lab file by parameter, each checked.

    Args:
        path: The file.
        specs: The parameters of the bridge.

    Raises:
        ParameterError: The file is refused, or a value lies outside what its parameter allows; names file and entry.
    """
    table = {spec.name: spec for spec in specs}
    places = {e.parameter: f"{section}.{name}" for section, es in LAB_ENTRIES.items() for name, e in es.items()}
    values = {}
    for name, value in load_lab(path).values.items():
        if name not in table:
            raise ParameterError(f"{path}: {places[name]} is not known to this program")
        values[name] = table[name].check(value, where=f"{path}: {places[name]}")
    return values
