"""ROS parameters from a table of specs: declared with range and description, checked, changeable at run time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import TYPE_NAMES, ParameterSpec, reject_unknown
from pendulum_msgs_py.ros.shared_parameters import given_to_every_node, refuse_near_misses

__all__ = ["NodeParameters"]

_PARAMETERS_OF_ROS = frozenset({"use_sim_time", "start_type_description_service"})
_PREFIXES_OF_ROS = ("qos_overrides.",)


class NodeParameters:
    """The parameters of a node.

    Args:
        node: The node; parameters from elsewhere must be declared before.
        specs: The table.
        prepare: Called with all values, changed ones included, before a change is accepted; a ParameterError refuses
            it. It must not have effects, as the change may still be refused elsewhere.
        apply: Called once a change is in force, with the result of ``prepare``, or else with all values.

    Raises:
        ParameterError: A value at start is refused, or a parameter is unknown, unless a file gives it to every node.
    """

    def __init__(
        self,
        node: Node,
        specs: Iterable[ParameterSpec],
        prepare: Callable[[Mapping[str, Any]], Any] | None = None,
        apply: Callable[[Any], None] | None = None,
    ) -> None:
        self._specs = {spec.name: spec for spec in specs}
        self._prepare = prepare
        self._apply = apply
        self._prepared: tuple[Any] | None = None
        self.values: dict[str, Any] = {}
        _refuse_unknown(node, self._specs)
        for spec in self._specs.values():
            self.values[spec.name] = self._declare(node, spec)
        self._simulated_time = bool(node.get_parameter_or("use_sim_time", Parameter("use_sim_time", value=False)).value)
        node.add_on_set_parameters_callback(self._check_change)
        node.add_post_set_parameters_callback(self._take_over)

    def __getitem__(self, name: str) -> Any:
        """Return the present value."""
        return self.values[name]

    @staticmethod
    def _declare(node: Node, spec: ParameterSpec) -> Any:
        try:
            parameter = node.declare_parameter(spec.name, spec.default, _descriptor(spec))
        except InvalidParameterTypeException as error:
            given = node._parameter_overrides.get(spec.name)
            value = given.value if given is not None else "of another type"
            decimals = _as_decimals(spec, value)
            hint = f"; ROS distinguishes whole numbers from decimals: write {decimals}" if decimals else ""
            raise ParameterError(
                f"{spec.name} is {_plain(value)!r}; expected {TYPE_NAMES[type(spec.default)]} {spec.domain}".rstrip()
                + hint
            ) from error
        except InvalidParameterValueException as error:
            given = node._parameter_overrides.get(spec.name)
            spec.check(given.value if given is not None else None)
            raise ParameterError(f"{spec.name} is refused: {error}; expected {spec.domain}") from error
        return spec.check(_plain(parameter.value))

    def _check_change(self, parameters: list[Parameter]) -> SetParametersResult:
        self._prepared = None
        try:
            changed = self._changed(parameters)
            if self._prepare is not None and changed != self.values:
                self._prepared = (self._prepare(changed),)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_over(self, parameters: list[Parameter]) -> None:
        changed = self._changed(parameters)
        if changed == self.values:
            return
        prepared, self._prepared = self._prepared, None
        self.values = changed
        if self._apply is not None:
            self._apply(changed if prepared is None else prepared[0])

    def _changed(self, parameters: list[Parameter]) -> dict[str, Any]:
        changed = dict(self.values)
        for parameter in parameters:
            spec = self._specs.get(parameter.name)
            if spec is not None:
                changed[parameter.name] = spec.check(_plain(parameter.value))
            elif parameter.name == "use_sim_time" and parameter.value != self._simulated_time:
                raise ParameterError(
                    f"use_sim_time is {str(self._simulated_time).lower()} since the start of this node, which reads it "
                    f"once; expected it at start: -p use_sim_time:={str(not self._simulated_time).lower()}"
                )
        return changed


def _refuse_unknown(node: Node, specs: Mapping[str, ParameterSpec]) -> None:
    """ROS would ignore a misspelt parameter silently. What a file gives to every node may belong to others."""
    given = [
        name
        for name in node._parameter_overrides
        if name not in _PARAMETERS_OF_ROS and not name.startswith(_PREFIXES_OF_ROS) and not node.has_parameter(name)
    ]
    unknown = [name for name in given if name not in specs]
    if not unknown:
        return
    where = node.get_fully_qualified_name()
    shared = given_to_every_node(sys.argv, where)
    refuse_near_misses((name for name in unknown if name in shared), specs, where=where)
    reject_unknown(dict.fromkeys(name for name in unknown if name not in shared), specs, where=where)
    left = ", ".join(sorted(unknown))
    node.get_logger().info(f"left to other nodes, from a section for every node: {left}")


def _plain(value: Any) -> object:
    return value if isinstance(value, (bool, int, float, str)) or value is None else list(value)


def _as_decimals(spec: ParameterSpec, value: object) -> str:
    """Return whole numbers as ROS wants decimals, or an empty string if that is not the problem."""
    if isinstance(spec.default, float) and isinstance(value, int) and not isinstance(value, bool):
        return str(float(value))
    if isinstance(spec.default, list) and spec.default and isinstance(spec.default[0], float):
        numbers = _plain(value)
        if isinstance(numbers, list) and all(type(number) is int for number in numbers):
            return str([float(number) for number in numbers])
    return ""


def _descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    unit = f" [{spec.unit}]" if spec.unit not in {"", "-"} else ""
    descriptor = ParameterDescriptor(
        name=spec.name,
        description=spec.description + unit,
        read_only=spec.read_only,
        additional_constraints=spec.domain,
    )
    # ROS has two-ended ranges only; a one-ended domain is in the constraints, and refused better by our own check than
    # by "out of range, Max: 1.797e+308".
    if spec.minimum is not None and spec.maximum is not None:
        if isinstance(spec.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(spec.minimum), to_value=float(spec.maximum))
            ]
        elif isinstance(spec.default, int) and not isinstance(spec.default, bool):
            descriptor.integer_range = [IntegerRange(from_value=int(spec.minimum), to_value=int(spec.maximum), step=1)]
    return descriptor
