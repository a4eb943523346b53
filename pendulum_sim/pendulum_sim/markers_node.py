"""``markers``: show torque and disturbance as arcs about the joint, in RViz and Foxglove.

RViz has an Effort display of its own, but it draws revolute joints only (ours turns without end, so it is a
continuous one) and drops messages whose ``frame_id`` is no frame (in ours it is who commands).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import command_from_bytes, plant_mode, stamp_to_message
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.timers import create_wall_timer
from pendulum_sim.shown_torques import SHOWN_TOPICS, ShownTorques

__all__ = ["SPECS", "MarkersNode", "arc_points", "main"]

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("frame", "base_link", "", "Frame of the joint, with the prefix of its plant.", read_only=True),
    ParameterSpec(
        "effort_scale", 13.0, "N m", "Torque whose arc is three quarters of a turn.",
        minimum=0.0, exclusive_minimum=True,
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
"""Topic: id of the marker, its radius as a multiple, its colour."""


def arc_points(effort: float, effort_scale: float, radius: float) -> list[tuple[float, float, float]]:
    """Return the polyline of a torque: an arc that starts above the joint, with an arrow's head at its end.

    Positive torque turns from +z towards -x, the way that the joint of our URDF turns (about -y).

    Args:
        effort: Torque [N m].
        effort_scale: Torque of three quarters of a turn, where the arc ends [N m].
        radius: Radius [m].

    Returns:
        Points (x, y, z) [m]; none for a torque too small to see.
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


class MarkersNode(Node):
    """Draws the torques of one plant.

    Args:
        stop: Asks the runner to end the process.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("markers")
        self._settings = NodeParameters(self, SPECS)
        self._torques = ShownTorques()
        self._publisher = self.create_publisher(MarkerArray, "markers", qos.TRAJECTORY)
        self.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        for topic in SHOWN_TOPICS:
            self.create_subscription(JointState, topic, self._receiver(topic), qos.NEWEST_STATE, raw=True)
        create_wall_timer(self, 1.0 / self._settings["rate"], self._publish)

    def _receiver(self, topic: str) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            command = command_from_bytes(data)
            if command is not None and len(command.effort) == 1 and math.isfinite(command.effort[0]):
                self._torques.note(topic, command.stamp_ns, command.effort[0])

        return receive

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._torques.mode = plant_mode(message, self.get_namespace()) or self._torques.mode

    def _publish(self) -> None:
        newest = self._torques.newest_ns
        self._publisher.publish(MarkerArray(markers=[self._marker(topic, newest) for topic in _ARCS]))

    def _marker(self, topic: str, newest_ns: int) -> Marker:
        number, factor, (red, green, blue) = _ARCS[topic]
        effort = self._torques.acting(topic, newest_ns)
        points = arc_points(effort, self._settings["effort_scale"], factor * self._settings["radius"])
        marker = Marker(ns=topic, id=number, type=Marker.LINE_STRIP)
        marker.header.frame_id = self._settings["frame"]
        marker.header.stamp = stamp_to_message(newest_ns)
        marker.action = Marker.ADD if points else Marker.DELETE
        marker.scale.x = 0.08 * self._settings["radius"]
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in points]
        marker.pose.orientation.w = 1.0
        return marker


def main(argv: Sequence[str] | None = None) -> int:
    """Run the markers node."""
    return run_node(
        MarkersNode,
        argv,
        program="pendulum_sim markers",
        description="Publishes applied torque, disturbance and push of a plant as arcs (visualization_msgs).",
        specs=SPECS,
        example="python -m pendulum_sim markers --ros-args -r __ns:=/sim -p frame:=sim/base_link",
    )
