"""Bring up one plant or both, with controller, disturbance, recorder, windows: what the experiment runs, by hand.

    ros2 launch pendulum_lqr bringup.launch.py plant:=both record:=true
    ros2 launch pendulum_lqr bringup.launch.py --show-args

Include it with ``IncludeLaunchDescription``; behind ``PushRosNamespace`` all its nodes and topics move along. Which
programs belong to a run, and under which names, is said in ``pendulum_msgs_py.graph``, which experiments read too.
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

from pendulum_lqr.controller import CONTROLLERS
from pendulum_lqr.disturbance import DISTURBANCE_SPECS
from pendulum_msgs_py import graph
from pendulum_msgs_py.graph import NodeProgram

SIDES = {"sim": ("sim",), "emulator": ("hw",), "hebi": ("hw",), "both": ("sim", "hw")}
KINDS = next(spec.choices for spec in DISTURBANCE_SPECS if spec.name == "kind")
YES_NO = ["true", "false"]


def arguments() -> list[DeclareLaunchArgument]:
    """Return the arguments, which ``--show-args`` lists."""
    return [
        DeclareLaunchArgument(
            "plant", default_value="sim", choices=list(SIDES),
            description="What to bring up: the simulator as /sim, the bridge to the emulated or the real X5-9 as /hw, "
            "or simulator and emulator.",
        ),
        DeclareLaunchArgument(
            "controller", default_value="lqr", choices=[*CONTROLLERS, "none"],
            description="Controller of each plant.",
        ),
        DeclareLaunchArgument(
            "disturbance", default_value="none", choices=[*KINDS, "none"],
            description="Disturbance on each plant; it starts when its service ~/start is called.",
        ),
        DeclareLaunchArgument(
            "disturb_at_start", default_value="false", choices=YES_NO,
            description="Start the disturbance with the first state instead.",
        ),
        DeclareLaunchArgument("seed", default_value="1", description="Seed of the disturbance; one seed, one torque."),
        DeclareLaunchArgument(
            "model", default_value="thesis",
            description="Preset (thesis, x5_9, dfki) or plant file: what is simulated and what the controller is "
            "designed for.",
        ),
        DeclareLaunchArgument(
            "start", default_value="bottom", choices=["bottom", "top"],
            description="Where a simulated or emulated pendulum starts.",
        ),
        DeclareLaunchArgument("sim_rate", default_value="500.0", description="Rate of the simulator [Hz]."),
        DeclareLaunchArgument("hw_rate", default_value="100.0", description="Rate of the bridge [Hz]."),
        DeclareLaunchArgument(
            "params_file", default_value="",
            description="ROS parameter file for all nodes, such as the config/lqr_thesis.yaml of this package.",
        ),
        DeclareLaunchArgument(
            "record", default_value="false", choices=YES_NO, description="Record each plant to a bag of its own."
        ),
        DeclareLaunchArgument(
            "bag", default_value="", description="Folder of the bags; runs/<date and time> when empty."
        ),
        DeclareLaunchArgument(
            "viewer", default_value="false", choices=YES_NO, description="Open a window that draws each plant."
        ),
        DeclareLaunchArgument(
            "rviz", default_value="false", choices=YES_NO,
            description="Show the plants in RViz, with markers for torque and disturbance.",
        ),
    ]  # fmt: skip


def programs(value: dict[str, str]) -> list[NodeProgram]:
    """Return the nodes of a run from the values of the arguments."""
    found: list[NodeProgram] = []
    for side in SIDES[value["plant"]]:
        space = f"/{side}"
        rate = float(value[f"{side}_rate"])
        if side == "sim":
            found.append(graph.simulator(space, plant=value["model"], rate_hz=rate, start=value["start"]))
        else:
            backend = "hebi" if value["plant"] == "hebi" else "emulator"
            top = value["start"] == "top" and backend == "emulator"
            start = {"initial_position": 3.141592653589793} if top else {}
            found.append(graph.bridge(space, backend=backend, feedback_rate=rate, **start))
        if value["controller"] != "none":
            found.append(
                graph.controller(
                    space, controller=value["controller"], plant=value["model"], period=1.0 / rate
                )
            )
        if value["disturbance"] != "none":
            found.append(
                graph.disturbance(
                    space,
                    kind=value["disturbance"],
                    seed=int(value["seed"]),
                    autostart=value["disturb_at_start"] == "true",
                )
            )
        if value["viewer"] == "true":
            found.append(NodeProgram("pendulum_sim", "viewer", space))
    return found


def to_action(program: NodeProgram, params_file: str, *, vital: bool) -> Node:
    """Return the launch action of a node.

    Args:
        program: The node.
        params_file: ROS parameter file whose values win, or empty.
        vital: Without it there is no run: its end ends the others.
    """
    return Node(
        package=program.package,
        executable=program.executable,
        name=program.node_name,
        # Relative, so that PushRosNamespace moves it.
        namespace=program.namespace.lstrip("/"),
        parameters=[dict(program.parameters), *([params_file] if params_file else [])],
        remappings=list(program.remappings.items()),
        output="screen",
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
        # It hears the plants' last words: it gets time to write them.
        sigterm_timeout="10",
    )


def bring_up(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return the actions for the arguments given."""
    value = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in arguments()}
    pushed = context.launch_configurations.get("ros_namespace", "").strip("/")
    outer = f"/{pushed}/" if pushed else "/"
    actions: list[LaunchDescriptionEntity] = []
    for program in programs(value):
        vital = program.executable in {"simulator", "bridge"}
        actions.append(to_action(program, value["params_file"], vital=vital))
    if value["record"] == "true":
        folder = Path(value["bag"] or f"runs/{time.strftime('%Y-%m-%d_%H-%M-%S')}").absolute()
        actions += [recorder(side, outer, folder) for side in SIDES[value["plant"]]]
    if value["rviz"] == "true":
        source = PathJoinSubstitution([FindPackageShare("pendulum_sim"), "launch", "rviz.launch.py"])
        for index, side in enumerate(SIDES[value["plant"]]):
            actions.append(
                IncludeLaunchDescription(
                    PythonLaunchDescriptionSource(source),
                    launch_arguments={
                        "plant_namespace": side, "model": value["model"], "y": str(0.6 * index),
                        "window": "true" if index == 0 else "false",
                    }.items(),
                )
            )  # fmt: skip
    return actions


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    return LaunchDescription([*arguments(), OpaqueFunction(function=bring_up)])
