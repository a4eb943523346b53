"""The lab file as parameters of a node: what it says is the default, what is given beside it wins and is told."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from rclpy.node import Node

from pendulum_hw_bridge.lab import LAB_SPEC, check_lab
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["given_backend", "given_plant", "with_lab_file"]


def given_plant(node: Node) -> str:
    """Return the plant that a node was given, whose joints decide the defaults of what is not."""
    given = node._parameter_overrides.get("plant")
    return "thesis" if given is None else str(given.value)


def given_backend(node: Node) -> str:
    """Return the backend that a node was given, which decides some of those defaults too."""
    given = node._parameter_overrides.get("backend")
    return "emulator" if given is None else str(given.value)


def with_lab_file(node: Node, specs: Iterable[ParameterSpec]) -> list[ParameterSpec]:
    """Return a node's parameters with the values of the lab file that it was given as their defaults.

    Args:
        node: The node; its parameter ``lab_file`` is not declared yet.
        specs: Its parameters, ``lab_file`` among them.

    Raises:
        ParameterError: The lab file is refused.
    """
    table = list(specs)
    overrides: Mapping[str, Any] = node._parameter_overrides
    given = overrides.get(LAB_SPEC.name)
    if given is None or not given.value:
        return table
    values = check_lab(str(given.value), table)
    for name in sorted(values.keys() & overrides.keys()):
        if overrides[name].value != values[name]:
            node.get_logger().warning(
                f"{name} is {overrides[name].value!r} as given, not {values[name]!r} as in the lab file"
            )
    return [dataclasses.replace(spec, default=values[spec.name]) if spec.name in values else spec for spec in table]
