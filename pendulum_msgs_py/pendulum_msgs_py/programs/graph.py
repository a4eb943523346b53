"""The graph of a run: programs with names and parameters, for experiments and launch files."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from pendulum_msgs_py.contract.names import full_name

__all__ = ["NodeProgram", "ParameterArgument", "bridge", "controller", "disturbance", "parameter_text", "simulator"]

ParameterArgument: TypeAlias = bool | int | float | str | list[str] | list[float]


@dataclass(frozen=True)
class NodeProgram:
    """One node as a program; ``namespace`` makes a plant's relative names unique, such as ``/sim``."""

    package: str
    executable: str
    namespace: str = "/"
    name: str = ""
    parameters: Mapping[str, ParameterArgument] = field(default_factory=dict)
    remappings: Mapping[str, str] = field(default_factory=dict)

    @property
    def node_name(self) -> str:
        """Name of the node, by default the executable's."""
        return self.name or self.executable

    @property
    def full_name(self) -> str:
        """Name with namespace."""
        return full_name(self.namespace, self.node_name)

    def ros_arguments(self) -> list[str]:
        """Return the arguments behind the executable."""
        arguments = ["--ros-args", "-r", f"__ns:={self.namespace}", "-r", f"__node:={self.node_name}"]
        for source, target in self.remappings.items():
            arguments += ["-r", f"{source}:={target}"]
        for name, value in self.parameters.items():
            arguments += ["-p", f"{name}:={parameter_text(value)}"]
        return arguments

    def command(self) -> list[str]:
        """Return the command line with this interpreter."""
        return [sys.executable, "-m", self.package, self.executable, *self.ros_arguments()]


def simulator(namespace: str, **parameters: ParameterArgument) -> NodeProgram:
    """Return the simulated plant."""
    return NodeProgram("pendulum_sim", "simulator", namespace, parameters=parameters)


def bridge(namespace: str, **parameters: ParameterArgument) -> NodeProgram:
    """Return the bridge to the actuator, real or emulated."""
    return NodeProgram("pendulum_hw_bridge", "bridge", namespace, parameters=parameters)


def controller(namespace: str, **parameters: ParameterArgument) -> NodeProgram:
    """Return the controller of a plant."""
    return NodeProgram("pendulum_lqr", "controller", namespace, parameters=parameters)


def disturbance(namespace: str, **parameters: ParameterArgument) -> NodeProgram:
    """Return the disturbance on a plant."""
    return NodeProgram("pendulum_lqr", "disturbance", namespace, parameters=parameters)


def parameter_text(value: ParameterArgument) -> str:
    """Return a value as text of the same type in ROS: text quoted, floats with a point."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 reads 1e-05 as text.
        return text if "." in text or "e" not in text else text.replace("e", ".0e")
    if isinstance(value, list):
        return "[" + ", ".join(parameter_text(element) for element in value) + "]"
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    return str(value)
