"""``markers``: show torque and disturbance as arcs about the joints, a force as an arrow, in RViz and Foxglove.

RViz's own Effort display draws revolute joints only (this one is continuous) and drops messages whose ``frame_id`` is
no frame (here it is the commander).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import command_from_bytes, plant_mode, plant_value, stamp_to_message
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.timers import create_wall_timer
from pendulum_sim.pictures.joint_frames import across, full_effort
from pendulum_sim.pictures.shown_plant import described_mechanism, shown_pendulum
from pendulum_sim.pictures.shown_torques import SHOWN_TOPICS, ShownTorques

__all__ = ["SPECS", "MarkersNode", "arc_points", "arrow_points", "joint_marker", "main"]

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("frame", "base_link", "", "Frame of the first joint, with its plant's prefix.", read_only=True),
    ParameterSpec(
        "effort_scale", 13.0, "N m",
        "Torque whose arc is three quarters of a turn; with several joints it is each motor's limit.", minimum=0.0,
        exclusive_minimum=True,
    ),
    ParameterSpec("radius", 0.12, "m", "Radius of the torque's arc.", minimum=0.0, exclusive_minimum=True),
    ParameterSpec("rate", 30.0, "Hz", "Arrays published per second.", minimum=1.0, maximum=120.0, read_only=True),
)  # fmt: skip

_FULL_ARC = 1.5 * math.pi
_STEPS = 48
_ARCS = {
    names.APPLIED_EFFORT: (0, 1.0, (0.13, 0.47, 0.71)),
    names.DISTURBANCE: (1, 1.3, (0.89, 0.47, 0.10)),
    names.PUSH: (2, 1.6, (0.58, 0.30, 0.70)),
}
"""Topic: id of the marker, relative radius, colour."""


def arc_points(effort: float, effort_scale: float, radius: float) -> list[tuple[float, float, float]]:
    """Return the polyline (x, y, z) of a torque [m]: an arc from above the joint, with an arrow head.

    Positive torque turns from +z towards -x, about the URDF's axis -y. At ``effort_scale`` the arc is three quarters of
    a turn; a torque too small to see has no points.
    """
    angle = _FULL_ARC * max(-1.0, min(1.0, effort / effort_scale))
    if abs(angle) < 0.01:
        return []
    steps = max(2, round(_STEPS * abs(angle) / _FULL_ARC))

    def at(turn: float, distance: float) -> tuple[float, float, float]:
        return (-distance * math.sin(turn), 0.0, distance * math.cos(turn))

    points = [at(angle * index / steps, radius) for index in range(steps + 1)]
    back = angle - math.copysign(min(0.15, abs(angle)), angle)
    return [*points, at(back, 1.1 * radius), points[-1], at(back, 0.9 * radius)]


def arrow_points(effort: float, effort_scale: float, radius: float) -> list[tuple[float, float]]:
    """Return the polyline of a force, along and across the slide [m]; its length is 3 radii at ``effort_scale``."""
    length = 3.0 * radius * max(-1.0, min(1.0, effort / effort_scale))
    if abs(length) < 0.01 * radius:
        return []
    back = length - math.copysign(min(0.3 * radius, abs(length)), length)
    return [(0.0, 0.0), (length, 0.0), (back, 0.15 * radius), (length, 0.0), (back, -0.15 * radius)]


class MarkersNode(Node):
    """Draws the torques of one plant; ``stop`` ends the process."""

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("markers")
        self._settings = NodeParameters(self, SPECS)
        self._torques = ShownTorques()
        self._description = ""
        self._mechanism: PlantParameters | None = None
        self._publisher = self.create_publisher(MarkerArray, "markers", qos.TRAJECTORY)
        self.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        for topic in SHOWN_TOPICS:
            self.create_subscription(JointState, topic, self._receiver(topic), qos.NEWEST_STATE, raw=True)
        create_wall_timer(self, 1.0 / self._settings["rate"], self._publish)

    def _receiver(self, topic: str) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            command = command_from_bytes(data)
            if command is not None:
                self._torques.note(topic, command)

        return receive

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        space = self.get_namespace()
        self._torques.mode = plant_mode(message, space) or self._torques.mode
        description = plant_value(message, space, PLANT_PARAMETERS)
        if description and description != self._description:
            self._description, self._mechanism = description, described_mechanism(description)

    def _publish(self) -> None:
        newest = self._torques.newest_ns
        plant = self._mechanism or shown_pendulum(self._settings["effort_scale"])
        markers = [
            self._of_a_joint(plant, index, topic, newest) for topic in _ARCS for index in range(len(plant.joints))
        ]
        self._publisher.publish(MarkerArray(markers=markers))

    def _of_a_joint(self, plant: PlantParameters, index: int, topic: str, newest_ns: int) -> Marker:
        joint = plant.mechanism.joints[index]
        effort = self._torques.acting(topic, newest_ns, joint.name)
        frame, points = joint_marker(
            plant, index, effort, self._settings["radius"], _ARCS[topic][1], self._settings["frame"]
        )
        space = topic if len(plant.joints) == 1 else f"{topic}/{joint.name}"
        return self._marker(topic, space, frame, points, newest_ns)

    def _marker(self, topic: str, space: str, frame: str, points: Sequence[Iterable[float]], newest_ns: int) -> Marker:
        number, _, (red, green, blue) = _ARCS[topic]
        marker = Marker(ns=space, id=number, type=Marker.LINE_STRIP)
        marker.header.frame_id = frame
        marker.header.stamp = stamp_to_message(newest_ns)
        marker.action = Marker.ADD if points else Marker.DELETE
        marker.scale.x = 0.08 * self._settings["radius"]
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
        marker.pose.orientation.w = 1.0
        return marker


def joint_marker(
    plant: PlantParameters, index: int, effort: float, radius: float, factor: float, base: str
) -> tuple[str, list[NDArray[np.float64]]]:
    """Return the frame in the plant's URDF of an effort's marker, and its polyline.

    A torque is an arc about the joint's axis, in the frame of the link before; a force is an arrow that moves along.
    ``factor`` scales the radius [m], for arcs outside of others; ``base`` is the first joint's frame, with prefix.
    """
    bodies, full = plant.mechanism.bodies(plant.packed), full_effort(plant, index)
    body = bodies[index]
    prefix = base[: base.rfind("/") + 1]
    right, up = across(body)
    if plant.mechanism.joints[index].unit == "m":
        along = np.array(body.axis)
        high = factor * radius * up
        return prefix + body.name, [x * along + z * up + high for x, z in arrow_points(effort, full, radius)]
    origin = np.array(body.origin)
    points = [origin + x * right + z * up for x, _, z in arc_points(effort, full, factor * radius)]
    return prefix + bodies[index - 1].name if index else base, points


def main(argv: Sequence[str] | None = None) -> int:
    """Run the markers node."""
    return run_node(
        MarkersNode,
        argv,
        program="pendulum_sim markers",
        description="Publishes torques, disturbance and push of a plant as arcs, and forces as arrows.",
        specs=SPECS,
        example="python -m pendulum_sim markers --ros-args -r __ns:=/sim -p frame:=sim/base_link",
    )
