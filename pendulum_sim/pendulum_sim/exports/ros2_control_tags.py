"""Elements of a URDF for ros2_control: the joint's interfaces, and the hardware behind them."""

from __future__ import annotations

from xml.etree import ElementTree

from pendulum_msgs_py.contract.names import JOINT, JOINT_STATES
from pendulum_msgs_py.errors import ParameterError

__all__ = ["HARDWARE", "add_ros2_control"]

HARDWARE = ("none", "gz", "topic_based")
"""None; Gazebo's simulation; a plant of this project, through its topics."""

_GZ_LIBRARY = "gz_ros2_control-system"
_GZ_PLUGIN = "gz_ros2_control::GazeboSimROS2ControlPlugin"
_CONTROLLERS = "$(find pendulum_lqr)/config/ros2_control_controllers.yaml"
_HEIGHT = 1.0


def add_ros2_control(robot: ElementTree.Element, hardware: str, namespace: str, effort_limit: float) -> None:
    """Add ros2_control's elements to a URDF; hardware is one of :data:`HARDWARE`, else a ParameterError.

    ``namespace`` is the plant's, for ``topic_based``; ``effort_limit`` in [N m].
    """
    if hardware not in HARDWARE:
        raise ParameterError(f"ros2_control is {hardware!r}; expected one of {', '.join(HARDWARE)}")
    if hardware == "none":
        return
    add = ElementTree.SubElement
    system = add(robot, "ros2_control", name="pendulum", type="system")
    block = add(system, "hardware")
    plugin = add(block, "plugin")
    if hardware == "gz":
        plugin.text = "gz_ros2_control/GazeboSimSystem"
    else:
        plugin.text = "topic_based_ros2_control/TopicBasedSystem"
        space = namespace.rstrip("/")
        parameters = {
            "joint_states_topic": f"{space}/{JOINT_STATES}",
            "joint_commands_topic": f"{space}/joint_commands",
            # It publishes a command only if positions and commanded positions differ by more than this; without
            # commanded positions a hanging pendulum would get none.
            "trigger_joint_command_threshold": "-1",
        }
        for name, value in parameters.items():
            add(block, "param", name=name).text = value
    joint = add(system, "joint", name=JOINT)
    command = add(joint, "command_interface", name="effort")
    for end, torque in (("min", -effort_limit), ("max", effort_limit)):
        add(command, "param", name=end).text = repr(torque)
    for name in ("position", "velocity", "effort"):
        add(joint, "state_interface", name=name)
    if hardware == "gz":
        # In Gazebo a model without a joint to the world falls, and a link without inertia is dropped with its joint.
        base = next(link for link in robot.iter("link") if link.get("name") == "base_link")
        inertial = add(base, "inertial")
        add(inertial, "mass", value="1.0")
        add(inertial, "inertia", ixx="0.002", iyy="0.002", izz="0.002", ixy="0", ixz="0", iyz="0")
        add(robot, "link", name="world")
        mount = add(robot, "joint", name="world_joint", type="fixed")
        add(mount, "parent", link="world")
        add(mount, "child", link="base_link")
        add(mount, "origin", xyz=f"0 0 {_HEIGHT}", rpy="0 0 0")
        outer = add(add(robot, "gazebo"), "plugin", filename=_GZ_LIBRARY, name=_GZ_PLUGIN)
        add(outer, "parameters").text = _CONTROLLERS
