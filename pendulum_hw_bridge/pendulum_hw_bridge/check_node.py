"""What the bridge would be told on the same command line, read as the bridge itself reads it, for the checklist."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from pendulum_hw_bridge import bridge_parameters
from pendulum_hw_bridge.actuator import ActuatorPort
from pendulum_hw_bridge.assembly import Assembly, assemble, for_plant
from pendulum_hw_bridge.bridge_consistency import check_consistency
from pendulum_hw_bridge.clocks import WallClock
from pendulum_hw_bridge.lab_node import given_plant, with_lab_file
from pendulum_hw_bridge.node_specs import SPECS
from pendulum_hw_bridge.safety import SafetyLimits
from pendulum_hw_bridge.settings import BridgeSettings
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.ros.leaving import leaving_graph
from pendulum_msgs_py.ros.middleware import set_middleware_defaults
from pendulum_msgs_py.ros.parameters import NodeParameters

__all__ = ["AsTheBridge", "as_the_bridge", "bridge_values", "machine_of"]


@dataclass(frozen=True)
class AsTheBridge:
    """What the bridge would make of its parameters.

    Attributes:
        values: All parameters.
        port: The actuator, not connected yet.
        settings: What it would set in the actuator.
        limits: Limits of its checks of feedback.
        plant: Drivetrain and link.
        window: Angles between which the armed plant must stay [rad].
    """

    values: Mapping[str, Any]
    port: ActuatorPort
    settings: BridgeSettings
    limits: SafetyLimits
    plant: PlantParameters
    window: tuple[float, float]


def bridge_values(ros_arguments: Sequence[str], given: Mapping[str, graph.ParameterArgument]) -> dict[str, Any]:
    """Return the parameters that the bridge would have.

    Args:
        ros_arguments: ``--ros-args`` and what follows: parameters, files of parameters, names.
        given: Further parameters, which win.

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
        # Nobody talks to it: it only reads, under the bridge's own name, what the bridge would read.
        node = Node("bridge", context=context, start_parameter_services=False, enable_rosout=False)
        try:
            return NodeParameters(node, with_lab_file(node, for_plant(SPECS, given_plant(node)))).values
        finally:
            with leaving_graph():
                node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)


def as_the_bridge(values: Mapping[str, Any]) -> AsTheBridge:
    """Return what the bridge would make of its parameters.

    Raises:
        ParameterError: They contradict each other.
    """
    plant = bridge_parameters.plant_of(values)
    limits = bridge_parameters.bridge_limits(values, plant)
    check_consistency(values, limits)
    gains = bridge_parameters.trajectory_gains(values)
    mapping = bridge_parameters.effort_mapping(values, plant, gains, limits)
    window = (limits.position_min[0], limits.position_max[0])
    settings = bridge_parameters.bridge_settings(
        values, effort=limits.effort[0], velocity=mapping.velocity_limit, gains=gains, window=window
    )
    return AsTheBridge(
        values,
        bridge_parameters.make_port(values, WallClock()),
        settings,
        bridge_parameters.safety_limits(values, limits.effort[0]),
        plant,
        window,
    )


def machine_of(values: Mapping[str, Any]) -> Assembly:
    """Return the machine of several modules that the bridge would make of its parameters.

    Raises:
        ParameterError: They contradict each other or the plant, or name real modules.
    """
    if values["backend"] == "hebi":
        raise ParameterError(
            f"backend is 'hebi' with plant {values['plant']!r}; expected 'emulator': several real modules are not "
            "checked yet"
        )
    return assemble(values, for_plant(SPECS, values["plant"]))
