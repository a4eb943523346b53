"""Show a plant in RViz: robot_state_publisher on the URDF of its parameters, markers for its torques, the window.

    ros2 launch pendulum_sim rviz.launch.py plant_namespace:=sim model:=thesis

Needs robot_state_publisher, tf2_ros and rviz2 of a full ROS installation.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_description_entity import LaunchDescriptionEntity
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from pendulum_msgs_py.plants.plant_parameters import PRESET_NAMES, load_mechanism
from pendulum_sim.exports.model_files import urdf


def arguments() -> list[DeclareLaunchArgument]:
    """Return the arguments, which ``--show-args`` lists."""
    return [
        DeclareLaunchArgument("plant_namespace", default_value="sim", description="Namespace of the plant to show."),
        DeclareLaunchArgument(
            "model",
            default_value="thesis",
            description=f"Preset ({PRESET_NAMES}, or one of several joints) or plant file that is drawn.",
        ),
        DeclareLaunchArgument("y", default_value="0.0", description="Where the plant stands on the y axis [m]."),
        DeclareLaunchArgument(
            "window",
            default_value="true",
            choices=["true", "false"],
            description="Open RViz; false only publishes what it shows, for a second plant or for Foxglove.",
        ),
    ]


def show(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return the actions for the arguments given."""
    value = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in arguments()}
    space = value["plant_namespace"].strip("/")
    prefix = f"{space}/" if space else ""
    frame = f"{prefix}base_link"
    actions: list[LaunchDescriptionEntity] = [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=space,
            parameters=[{"robot_description": urdf(load_mechanism(value["model"])), "frame_prefix": prefix}],
        ),
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name=f"place_{space.replace('/', '_') or 'plant'}",
            arguments=["--y", value["y"], "--frame-id", "world", "--child-frame-id", frame],
        ),
        Node(
            package="pendulum_sim",
            executable="markers",
            name="markers",
            namespace=space,
            parameters=[{"frame": frame}],
        ),
    ]
    if value["window"] == "true":
        configuration = Path(FindPackageShare("pendulum_sim").perform(context), "rviz", "pendulum.rviz")
        actions.append(Node(package="rviz2", executable="rviz2", arguments=["-d", str(configuration)]))
    return actions


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    return LaunchDescription([*arguments(), OpaqueFunction(function=show)])
