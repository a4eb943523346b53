"""Parameters and modules for the checklist, from the command line as the bridge reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from pendulum_hw_bridge.bridge.assembly import Assembly, assemble, for_plant
from pendulum_hw_bridge.bridge.lab_node import specs_of
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import is_mechanism
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.ros.leaving import leaving_graph
from pendulum_msgs_py.ros.middleware import set_middleware_defaults
from pendulum_msgs_py.ros.parameters import NodeParameters

__all__ = ["bridge_values", "machine_of"]


def bridge_values(ros_arguments: Sequence[str], given: Mapping[str, graph.ParameterArgument]) -> dict[str, Any]:
    """Return the parameters that the bridge would have; ``given`` ones take precedence.

    Raises:
        ParameterError: A parameter, a file or the lab file is refused.
    """
    program = graph.bridge("/", **given)
    arguments = [*ros_arguments, "--ros-args"]
    for name, value in program.parameters.items():
        arguments += ["-p", f"{name}:={graph.parameter_text(value)}"]
    context = Context()
    try:
        set_middleware_defaults()
        rclpy.init(args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        raise ParameterError(f"ROS arguments are not understood: {' '.join(str(error).split())}") from error
    try:
        # This node only reads parameters, under the bridge's own name.
        node = Node("bridge", context=context, start_parameter_services=False, enable_rosout=False)
        try:
            return NodeParameters(node, specs_of(node)).values
        finally:
            with leaving_graph():
                node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)


def machine_of(values: Mapping[str, Any]) -> Assembly:
    """Return the machine that the bridge would make of its parameters.

    Raises:
        ParameterError: They contradict each other or the plant, or name several real modules.
    """
    if values["backend"] == "hebi" and is_mechanism(values["plant"]):
        raise ParameterError(
            f"backend is 'hebi' with plant {values['plant']!r}; expected 'emulator': several real modules are not "
            "checked yet"
        )
    return assemble(values, for_plant(SPECS, values["plant"], values["backend"]))
