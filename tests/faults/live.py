"""A running system of real processes on real DDS, a probe that attacks it, and what the probe saw."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState

from pendulum_bags.experiment.conductor_node import Conductor
from pendulum_bags.experiment.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.experiment.run_folder import write_json
from pendulum_msgs_py import graph, names
from pendulum_msgs_py.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.graph import NodeProgram
from pendulum_msgs_py.ros import qos

__all__ = ["EFFORT_LIMIT", "LiveSystem"]

EFFORT_LIMIT = 5.0
"""Limit given to the plant under attack, below what an angry controller asks for [N m]."""
START_TIMEOUT = 60.0
_NAMESPACE = "/sim"


class LiveSystem:
    """Simulator, controller, disturbance and recorder as processes, upright under noise; and a probe among them.

    The probe hears commands and applied torque, so it knows how long torque outlives the last command.

    Args:
        folder: For logs and the bag.
        domain: ROS domain of the system's own.
    """

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.domain = domain
        self.children: dict[str, Child] = {}
        self.applied: list[tuple[float, float]] = []
        self.commands: list[float] = []
        self._bags = 0

    def __enter__(self) -> LiveSystem:
        """Start everything and wait until torque flows."""
        logs = self.folder / "logs"
        self.processes = ProcessSet(logs, ros_environment(self.domain, logs))
        self.processes.__enter__()
        self.conductor = Conductor(self.domain)
        self.conductor.__enter__()
        node = self.conductor.node
        node.create_subscription(
            JointState, f"{_NAMESPACE}/{names.APPLIED_EFFORT}", self._on_applied, qos.STATE, raw=True
        )
        node.create_subscription(
            JointState,
            f"{_NAMESPACE}/{names.EFFORT_COMMAND}",
            self._on_command,
            qos.command_input(reliable=True),
            raw=True,
        )
        for name in ("recorder", "simulator", "controller", "disturbance"):
            self.start(name)
        self.wait_for("torque to flow", self.torque_flows, START_TIMEOUT)
        return self

    def __exit__(self, *_: object) -> None:
        """End everything."""
        for child in self.children.values():
            # A stopped process does not hear a polite signal.
            child.process.send_signal(signal.SIGCONT)
        self.processes.stop()
        self.conductor.__exit__(None, None, None)

    # --- processes -----------------------------------------------------------------------------------------

    def start(self, name: str, **changes: graph.ParameterArgument) -> Child:
        """Start one of the nodes, or start it again."""
        if name == "recorder":
            self._bags += 1
            metadata = self.folder / "metadata.json"
            write_json(metadata, {"pendulum.run": {"experiment": "faults"}})
            child = start_recorder(self.processes, self.bag, _NAMESPACE, metadata, "mcap")
        else:
            child = self.processes.start_node(self.program(name, **changes))
        self.children[name] = child
        return child

    @staticmethod
    def program(name: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the description of one of the nodes."""
        if name == "simulator":
            return graph.simulator(_NAMESPACE, initial_theta=math.pi, effort_limit=EFFORT_LIMIT, **changes)
        if name == "controller":
            return graph.controller(_NAMESPACE, **changes)
        return graph.disturbance(_NAMESPACE, autostart=True, hold_time=0.01, **changes)

    @property
    def bag(self) -> Path:
        """The bag that is being recorded."""
        return self.folder / f"bag_{self._bags}"

    def send(self, name: str, number: int) -> None:
        """Send a signal to a node."""
        self.children[name].process.send_signal(number)

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        """End a node and forget it."""
        child = self.children.pop(name)
        child.process.send_signal(number)
        child.process.wait(15.0)
        self.processes.children.remove(child)

    def alive(self) -> list[str]:
        """Return the names of the nodes that run."""
        return [name for name, child in self.children.items() if child.process.poll() is None]

    def memory(self, name: str) -> float:
        """Return the resident memory of a node [MB]."""
        status = Path(f"/proc/{self.children[name].process.pid}/statm").read_text(encoding="ascii")
        return int(status.split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    # --- the probe -----------------------------------------------------------------------------------------

    def listen(self, duration: float) -> None:
        """Let the probe listen for a while [s]."""
        deadline = time.monotonic() + duration
        while (left := deadline - time.monotonic()) > 0.0:
            self.conductor.listen(min(0.02, left))

    def wait_for(self, what: str, predicate: Callable[[], bool], timeout: float) -> None:
        """Wait until a predicate holds; raises FaultError with ``what`` otherwise."""
        self.conductor.wait_for(what, predicate, timeout)

    def torque_flows(self) -> bool:
        """Tell whether torque was applied within the last 50 ms."""
        now = time.monotonic()
        return any(effort != 0.0 for when, effort in self.applied[-40:] if now - when < 0.05)

    def time_to_zero(self, patience: float = 1.0) -> float:
        """Return the time from the last command to the first zero torque after it [s]; inf where it did not come."""
        self.listen(patience)
        if not self.commands:
            return math.inf
        last = self.commands[-1]
        after = [(when, effort) for when, effort in self.applied if when > last]
        # The torque must stay zero: find the last one that was not.
        driven = [when for when, effort in after if effort != 0.0]
        return (driven[-1] if driven else last) - last if after and after[-1][1] == 0.0 else math.inf

    def largest_torque(self) -> float:
        """Return the largest torque that was ever applied [N m]."""
        return max((abs(effort) for _, effort in self.applied), default=0.0)

    def rate(self, duration: float = 1.0) -> float:
        """Listen for a while and return how many torques a second were applied [Hz]."""
        before = len(self.applied)
        started = time.monotonic()
        self.listen(duration)
        return (len(self.applied) - before) / (time.monotonic() - started)

    def publisher(self, topic: str) -> Publisher:
        """Return a publisher of the probe's on one of the plant's inputs."""
        return self.conductor.node.create_publisher(JointState, f"{_NAMESPACE}/{topic}", qos.COMMAND)

    def attack(self, topic: str, messages: Iterable[JointState | bytes], *, rate: float | None = None) -> int:
        """Publish messages on an input and return how many were sent.

        Args:
            topic: The input.
            messages: What to send.
            rate: Messages per second; None as fast as possible.
        """
        publisher = self.publisher(topic)
        self.wait_for(
            f"the plant to hear the probe on {topic}", lambda: publisher.get_subscription_count() > 0, 10.0
        )
        sent = 0
        started = time.monotonic()
        for message in messages:
            publisher.publish(message)
            sent += 1
            if rate is not None:
                while time.monotonic() - started < sent / rate:
                    self.conductor.listen(0.0005)
            elif sent % 200 == 0:
                self.conductor.listen(0.0)
        self.listen(0.2)
        self.conductor.node.destroy_publisher(publisher)
        return sent

    def flood(self, effort: float) -> Iterable[bytes]:
        """Yield well-formed commands of a stranger, stamped now, for ever."""
        while True:
            yield encode_joint_state(time.time_ns(), frame_id="/stranger", effort=effort)

    def _on_applied(self, data: bytes) -> None:
        fields = decode_joint_state(data)
        if fields is not None and fields.effort is not None:
            self.applied.append((time.monotonic(), fields.effort))

    def _on_command(self, data: bytes) -> None:
        fields = decode_joint_state(data)
        if fields is not None and fields.frame_id == f"{_NAMESPACE}/controller":
            self.commands.append(time.monotonic())
