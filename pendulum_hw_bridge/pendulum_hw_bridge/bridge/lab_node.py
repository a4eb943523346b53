"""The lab file as defaults of a node's parameters; explicit parameters take precedence and are logged."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from rclpy.node import Node

from pendulum_hw_bridge.bridge.assembly import for_plant
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.lab_file import LAB_ENTRIES, load_lab

__all__ = ["specs_of"]


def specs_of(node: Node) -> tuple[ParameterSpec, ...]:
    """Return the bridge's parameters with defaults from the plant, backend and lab file of a node without any declared.

    Raises:
        ParameterError: There is no such plant, or the lab file is refused.
    """
    overrides: Mapping[str, Any] = node._parameter_overrides
    lab = overrides.get("lab_file")
    of_lab = load_lab(str(lab.value)).values if lab is not None and lab.value else {}
    given = {**of_lab, **{name: overrides[name].value for name in ("plant", "backend") if name in overrides}}
    backend = str(given.get("backend", "emulator"))
    table = for_plant(SPECS, str(given.get("plant", "thesis")), backend)
    if lab is None or not lab.value:
        return table
    values = _read(str(lab.value), table)
    for name in sorted(values.keys() & overrides.keys()):
        if overrides[name].value != values[name]:
            node.get_logger().warning(
                f"{name} is {overrides[name].value!r} as given, not {values[name]!r} as in the lab file"
            )
    return tuple(dataclasses.replace(spec, default=values.get(spec.name, spec.default)) for spec in table)


def _read(path: str, specs: Iterable[ParameterSpec]) -> dict[str, Any]:
    """Return the values of a lab file by parameter, each checked by the table of parameters."""
    table = {spec.name: spec for spec in specs}
    places = {e.parameter: f"{section}.{name}" for section, es in LAB_ENTRIES.items() for name, e in es.items()}
    values = {}
    for name, value in load_lab(path).values.items():
        if name not in table:
            raise ParameterError(f"{path}: {places[name]} is not known to this program")
        values[name] = table[name].check(value, where=f"{path}: {places[name]}")
    return values
