"""Sends messages or requests to a plant as fast as it can: ``python -m tests.tools.faults.flood /hw bridge calls``."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable

import rclpy
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pendulum_bags.experiments.session import ANSWER_PRIORITY, permitted
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.programs.realtime import run_in_real_time
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.middleware import set_middleware_defaults

__all__ = ["HELD_EFFORT"]

HELD_EFFORT = 0.45
"""Torque that a flood of efforts asks for [N m]: a plant lets a commander begin with it."""


def _commands(node: Node, namespace: str, _: str) -> Callable[[], None]:
    publisher = node.create_publisher(JointState, f"{namespace}/{names.EFFORT_COMMAND}", qos.COMMAND)
    return lambda: publisher.publish(encode_joint_state(time.time_ns(), frame_id="/stranger", effort=100.0))


def _efforts(node: Node, namespace: str, _: str) -> Callable[[], None]:
    # Of a commander that is rightful and small enough to begin: each of them is accepted, and has the motor driven.
    publisher = node.create_publisher(JointState, f"{namespace}/{names.EFFORT_COMMAND}", qos.COMMAND)
    return lambda: publisher.publish(encode_joint_state(time.time_ns(), frame_id="/flood", effort=HELD_EFFORT))


def _answers(node: Node, namespace: str, _: str) -> Callable[[], None]:
    """No flood: answer each state once, as a controller does, with torques that change."""
    publisher = node.create_publisher(JointState, f"{namespace}/{names.EFFORT_COMMAND}", qos.COMMAND)

    def answer(state: JointState) -> None:
        effort = HELD_EFFORT - 0.1 * (1.0 + math.sin(2.0 * math.pi * time.monotonic()))
        command = JointState(name=state.name, effort=[effort] * len(state.name))
        command.header.stamp, command.header.frame_id = state.header.stamp, "/flood"
        publisher.publish(command)

    node.create_subscription(JointState, f"{namespace}/{names.JOINT_STATES}", answer, qos.NEWEST_STATE)
    run_in_real_time(permitted(ANSWER_PRIORITY))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    return lambda: executor.spin_once(0.1)


def _arming(node: Node, namespace: str, plant: str) -> Callable[[], None]:
    client = node.create_client(SetBool, names.ARM.replace("~", f"{namespace}/{plant}"))
    client.wait_for_service(20.0)
    return lambda: client.remove_pending_request(client.call_async(SetBool.Request(data=True)))


def _trajectories(points: int) -> Callable[[Node, str, str], Callable[[], None]]:
    def make(node: Node, namespace: str, _: str) -> Callable[[], None]:
        publisher = node.create_publisher(JointTrajectory, f"{namespace}/{names.JOINT_TRAJECTORY}", qos.TRAJECTORY)
        message = JointTrajectory(joint_names=[names.JOINT])
        message.points = [JointTrajectoryPoint(positions=[0.0]) for _ in range(points)]
        data = serialize_message(message)
        return lambda: publisher.publish(data)

    return make


def _parameters(node: Node, namespace: str, plant: str) -> Callable[[], None]:
    client = node.create_client(SetParameters, f"{namespace}/{plant}/set_parameters")
    client.wait_for_service(20.0)
    value = ParameterValue(type=3, double_value=1.0)
    request = SetParameters.Request(parameters=[Parameter(name=f"unknown_{i}", value=value) for i in range(20)])
    return lambda: client.remove_pending_request(client.call_async(request))


def _large_parameters(node: Node, namespace: str, plant: str) -> Callable[[], None]:
    client = node.create_client(SetParameters, f"{namespace}/{plant}/set_parameters")
    client.wait_for_service(20.0)
    unknown = Parameter(name="a", value=ParameterValue(type=3, double_value=1.0))
    request = SetParameters.Request(parameters=[unknown] * 125_000)
    return lambda: client.remove_pending_request(client.call_async(request))


def _calls(node: Node, namespace: str, plant: str) -> Callable[[], None]:
    # A question that changes nothing: a flood of resets would rightly let the plant be armed after the press.
    client = node.create_client(ListParameters, f"{namespace}/{plant}/list_parameters")
    client.wait_for_service(20.0)
    return lambda: client.remove_pending_request(client.call_async(ListParameters.Request()))


_KINDS: dict[str, Callable[[Node, str, str], Callable[[], None]]] = {
    "commands": _commands,
    "trajectories": _trajectories(2000),
    "long_trajectories": _trajectories(200_000),
    "parameters": _parameters,
    "large_parameters": _large_parameters,
    "calls": _calls,
    "arming": _arming,
    "efforts": _efforts,
    "answers": _answers,
}


def main(namespace: str, plant: str, kind: str) -> int:
    """Flood until SIGINT."""
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, frame: stopped.append(received))
    set_middleware_defaults()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("stranger")
    send = _KINDS[kind](node, namespace, plant)
    sent, started = 0, time.monotonic()
    print("flooding", flush=True)
    while not stopped:
        send()
        sent += 1
    print(f"sent {sent / (time.monotonic() - started):.0f} a second", flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
