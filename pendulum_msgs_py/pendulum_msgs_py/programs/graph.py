"""The graph of a run: which programs, under which names and parameters. Experiments and launch files read it."""

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
    """One node as a program.

    Attributes:
        package: ROS package.
        executable: Its executable.
        namespace: Namespace that makes a plant's relative names unique, such as ``/sim``.
        name: Node name.
        parameters: ROS parameters.
        remappings: Names to remap.
    """

    package: str
    executable: str
    namespace: str = "/"
    name: str = ""
    parameters: Mapping[str, ParameterArgument] = field(default_factory=dict)
    remappings: Mapping[str, str] = field(default_factory=dict)

    @property
    def node_name(self) -> str:
        """Name of the node; that of the executable unless given."""
        return self.name or self.executable

    @property
    def full_name(self) -> str:
        """Name with namespace."""
        return full_name(self.namespace, self.node_name)

    def ros_arguments(self) -> list[str]:
        """Return what follows the executable on a command line."""
        arguments = ["--ros-args", "-r", f"__ns:={self.namespace}", "-r", f"__node:={self.node_name}"]
        for source, target in self.remappings.items():
            arguments += ["-r", f"{source}:={target}"]
        for name, value in self.parameters.items():
            arguments += ["-p", f"{name}:={parameter_text(value)}"]
        return arguments

    def command(self) -> list[str]:
        """Return the command that starts it with this interpreter."""
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
    """Write a value so that ROS reads back the same type: text quoted, floats with a point."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 takes 1e-05 for text.
        return text if "." in text or "e" not in text else text.replace("e", ".0e")
    if isinstance(value, list):
        return "[" + ", ".join(parameter_text(element) for element in value) + "]"
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    return str(value)
