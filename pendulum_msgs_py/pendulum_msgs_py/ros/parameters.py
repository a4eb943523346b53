"""ROS parameters from a table of specs: declared with range and description, checked, changeable at run time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["NodeParameters"]

_LARGEST_DOUBLE = 1.7976931348623157e308


class NodeParameters:
    """The parameters of a node, as its table of specs says.

    Args:
        node: The node.
        specs: The table.
        on_change: Called with all values, changed ones included, before a change is accepted; what it raises as
            ParameterError refuses the change, and everything stays as it was.

    Raises:
        ParameterError: A value given at start is refused.
    """

    def __init__(
        self,
        node: Node,
        specs: Iterable[ParameterSpec],
        on_change: Callable[[Mapping[str, Any]], None] | None = None,
    ) -> None:
        self._specs = {spec.name: spec for spec in specs}
        self._on_change = on_change
        self.values: dict[str, Any] = {}
        for spec in self._specs.values():
            self.values[spec.name] = self._declare(node, spec)
        node.add_on_set_parameters_callback(self._check_change)

    def __getitem__(self, name: str) -> Any:
        """Return the value in force."""
        return self.values[name]

    @staticmethod
    def _declare(node: Node, spec: ParameterSpec) -> Any:
        try:
            parameter = node.declare_parameter(spec.name, spec.default, _descriptor(spec))
        except InvalidParameterTypeException as error:
            given = node._parameter_overrides.get(spec.name)
            value = given.value if given is not None else "of another type"
            hint = ""
            if isinstance(spec.default, float) and isinstance(value, int):
                hint = f"; ROS tells whole numbers and decimals apart: write {float(value)}"
            raise ParameterError(
                f"{spec.name} is {value!r}; expected {_kind(spec)} {spec.domain}".rstrip() + hint
            ) from error
        except InvalidParameterValueException as error:
            given = node._parameter_overrides.get(spec.name)
            spec.check(given.value if given is not None else None)
            raise ParameterError(f"{spec.name} is refused: {error}; expected {spec.domain}") from error
        value = parameter.value
        return spec.check(list(value) if isinstance(spec.default, list) else value)

    def _check_change(self, parameters: list[Parameter]) -> SetParametersResult:
        changed = dict(self.values)
        try:
            for parameter in parameters:
                spec = self._specs.get(parameter.name)
                if spec is None:
                    continue
                value = list(parameter.value) if isinstance(spec.default, list) else parameter.value
                changed[parameter.name] = spec.check(value)
            if self._on_change is not None and changed != self.values:
                self._on_change(changed)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.values = changed
        return SetParametersResult(successful=True)


def _kind(spec: ParameterSpec) -> str:
    kinds = {bool: "true or false", int: "an integer", float: "a number", str: "text", list: "a list"}
    return kinds[type(spec.default)]


def _descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    unit = f" [{spec.unit}]" if spec.unit not in {"", "-"} else ""
    descriptor = ParameterDescriptor(
        name=spec.name, description=spec.description + unit, read_only=spec.read_only, additional_constraints=spec.domain
    )
    bounded = spec.minimum is not None or spec.maximum is not None
    if bounded and isinstance(spec.default, float):
        low = -_LARGEST_DOUBLE if spec.minimum is None else float(spec.minimum)
        high = _LARGEST_DOUBLE if spec.maximum is None else float(spec.maximum)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif bounded and isinstance(spec.default, int) and not isinstance(spec.default, bool):
        low_integer = -(2**63) if spec.minimum is None else int(spec.minimum)
        high_integer = 2**63 - 1 if spec.maximum is None else int(spec.maximum)
        descriptor.integer_range = [IntegerRange(from_value=low_integer, to_value=high_integer, step=1)]
    return descriptor
