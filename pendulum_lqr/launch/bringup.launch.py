"""Bring up one plant or both, with controller, disturbance, recorder, windows: what the experiment runs, by hand.

    ros2 launch pendulum_lqr bringup.launch.py plant:=both record:=true
    ros2 launch pendulum_lqr bringup.launch.py --show-args

Include it with ``IncludeLaunchDescription``; behind ``PushRosNamespace`` all its nodes and topics move along. Which
programs belong to a run, and under which names, is defined in :mod:`pendulum_msgs_py.programs.graph`, for experiments
too.
"""

import time
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, Shutdown
from launch.launch_description_entity import LaunchDescriptionEntity
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from pendulum_lqr.nodes.bringup import ARGUMENTS, SIDES, parameter_file, programs
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.programs.starter import bound_environment

PLANTS = {"simulator", "bridge"}


def to_action(program: NodeProgram, params_file: str) -> Node:
    """Return the launch action of a node; the end of a plant ends the others.

    Args:
        program: The node.
        params_file: ROS parameter file whose values win, or empty.
    """
    vital = program.executable in PLANTS
    return Node(
        package=program.package,
        executable=program.executable,
        name=program.node_name,
        # Relative, so that PushRosNamespace moves it.
        namespace=program.namespace.lstrip("/"),
        parameters=[dict(program.parameters), *([params_file] if params_file else [])],
        remappings=list(program.remappings.items()),
        output="screen",
        additional_env=bound_environment({}),
        on_exit=Shutdown(reason=f"{program.full_name} has ended") if vital else None,
    )


def recorder(side: str, outer: str, folder: Path) -> Node:
    """Return the recorder of all topics of one plant; ``outer`` is the namespace around it, with both slashes."""
    return Node(
        package="pendulum_bags",
        executable="record",
        name="recorder",
        namespace=side,
        arguments=["-o", str(folder / side), "--regex", f"^({outer}{side}/.*|/diagnostics|/clock)$"],
        output="screen",
        additional_env=bound_environment({}),
        # It records the plants' last messages and needs time to write them.
        sigterm_timeout="10",
    )


def rviz(side: str, model: str, place: int) -> IncludeLaunchDescription:
    """Return the display of one plant; the first one opens the window."""
    source = PathJoinSubstitution([FindPackageShare("pendulum_sim"), "launch", "rviz.launch.py"])
    window = "true" if place == 0 else "false"
    given = {"plant_namespace": side, "model": model, "y": str(0.6 * place), "window": window}
    return IncludeLaunchDescription(PythonLaunchDescriptionSource(source), launch_arguments=given.items())


def bring_up(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return the actions for the arguments given."""
    value = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in ARGUMENTS}
    sides = SIDES[value["plant"]]
    parameters = parameter_file(value["params_file"])
    actions: list[LaunchDescriptionEntity] = [to_action(it, parameters) for it in programs(value)]
    if value["record"] == "true":
        pushed = context.launch_configurations.get("ros_namespace", "").strip("/")
        outer = f"/{pushed}/" if pushed else "/"
        folder = Path(value["bag"] or f"runs/{time.strftime('%Y-%m-%d_%H-%M-%S')}").absolute()
        actions += [recorder(side, outer, folder) for side in sides]
    if value["rviz"] == "true":
        actions += [rviz(side, value["model"], place) for place, side in enumerate(sides)]
    return actions


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    declared = [
        DeclareLaunchArgument(
            it.name, default_value=it.default, description=it.description, choices=list(it.choices) or None
        )
        for it in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=bring_up)])
