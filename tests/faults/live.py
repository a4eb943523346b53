"""A running system of real processes on real DDS, a probe that attacks it, and what the probe saw."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState

from pendulum_bags.experiments.conductor_node import Conductor
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.ros import qos

__all__ = ["EFFORT_LIMIT", "NAMESPACE", "NODES", "START_TIMEOUT", "Applied", "LiveSystem"]

EFFORT_LIMIT = 5.0
"""Limit given to the plant under attack, below what an angry controller asks for [N m]."""
START_TIMEOUT = 60.0
NAMESPACE = "/sim"
NODES = ("recorder", "simulator", "controller", "disturbance")
"""The nodes of the system, in the order in which they usually start."""


class Applied(NamedTuple):
    """A torque that the plant says it applied.

    Attributes:
        when: When the probe heard of it, on its monotonic clock [s].
        effort: Torque [N m].
        stamp_ns: Stamp of the state from which on it acted [ns].
    """

    when: float
    effort: float
    stamp_ns: int


class LiveSystem:
    """Simulator, controller, disturbance and recorder as processes, upright under noise; and a probe among them.

    The probe hears commands and applied torque, so it knows how long torque outlives the last command.

    Args:
        folder: For logs and the bag.
        domain: ROS domain of the system's own.
        order: The nodes to start, in this order; none of them is waited for.
        environment: Variables to add for the nodes.
        parameters: ROS parameters to add for a node, by its name.

    Attributes:
        applied: Every torque that the plant said it applied.
        commands: When the controller's commands were heard, on the probe's monotonic clock [s].
        diagnostics: Newest key-value pairs by name of the status, such as ``/sim/simulator: plant``.
        diagnosed: When each status was heard last, on the probe's monotonic clock [s].
    """

    def __init__(
        self,
        folder: Path,
        domain: int,
        *,
        order: Sequence[str] = NODES,
        environment: Mapping[str, str] | None = None,
        parameters: Mapping[str, Mapping[str, graph.ParameterArgument]] | None = None,
    ) -> None:
        self.folder = folder
        self.domain = domain
        self.children: dict[str, Child] = {}
        self.applied: list[Applied] = []
        self.commands: list[float] = []
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.diagnosed: dict[str, float] = {}
        self._order = order
        self._environment = environment or {}
        self._parameters = parameters or {}
        self._bags = 0

    def __enter__(self) -> LiveSystem:
        """Start everything and wait until torque flows."""
        logs = self.folder / "logs"
        self.processes = ProcessSet(logs, {**ros_environment(self.domain, logs), **self._environment})
        self.processes.__enter__()
        self.conductor = Conductor(self.domain)
        self.conductor.__enter__()
        node = self.conductor.node
        node.create_subscription(
            JointState, f"{NAMESPACE}/{names.APPLIED_EFFORT}", self._on_applied, qos.STATE, raw=True
        )
        node.create_subscription(
            JointState,
            f"{NAMESPACE}/{names.EFFORT_COMMAND}",
            self._on_command,
            qos.COMMAND,
            raw=True,
        )
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        for name in self._order:
            self.start(name)
        if self._order:
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
            child = start_recorder(self.processes, self.bag, NAMESPACE, metadata, "mcap")
        else:
            child = self.processes.start_node(self.program(name, **{**self._parameters.get(name, {}), **changes}))
        self.children[name] = child
        return child

    @staticmethod
    def program(name: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the description of one of the nodes."""
        if name == "simulator":
            return graph.simulator(NAMESPACE, initial_theta=math.pi, effort_limit=EFFORT_LIMIT, **changes)
        if name == "controller":
            return graph.controller(NAMESPACE, **changes)
        if name == "viewer":
            return NodeProgram("pendulum_sim", "viewer", NAMESPACE, parameters={"window": False, "fps": 5.0, **changes})
        return graph.disturbance(NAMESPACE, autostart=True, hold_time=0.01, **changes)

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

    def finish_all(self) -> list[str]:
        """End all nodes as Ctrl-C does, recorders last; return a sentence for each that did not end well."""
        complaints = []
        for name in sorted(self.children, key=lambda name: name == "recorder"):
            child = self.children.pop(name)
            code = self.processes.finish(child, START_TIMEOUT)
            if code:
                complaints.append(f"{name} ended with code {code}: {child.last_words(1)}")
        return complaints

    def is_on_graph(self, name: str) -> bool:
        """Tell whether a node of this name has been discovered."""
        return (name, NAMESPACE) in self.conductor.node.get_node_names_and_namespaces()

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
        return any(applied.effort != 0.0 for applied in self.applied[-40:] if now - applied.when < 0.05)

    def hears_controller(self) -> bool:
        """Tell whether the probe has heard the controller within the last 50 ms: it is matched to this very process."""
        return bool(self.commands) and time.monotonic() - self.commands[-1] < 0.05

    def time_to_zero(self, patience: float = 1.0) -> float:
        """Return the time from the last command to the first zero torque after it [s]; inf where it did not come."""
        self.listen(patience)
        if not self.commands:
            return math.inf
        last = self.commands[-1]
        after = [applied for applied in self.applied if applied.when > last]
        # The torque must stay zero: find the last one that was not.
        driven = [applied.when for applied in after if applied.effort != 0.0]
        return (driven[-1] if driven else last) - last if after and after[-1].effort == 0.0 else math.inf

    def largest_torque(self) -> float:
        """Return the largest torque that was ever applied [N m]."""
        return max((abs(applied.effort) for applied in self.applied), default=0.0)

    def rate(self, duration: float = 1.0) -> float:
        """Listen for a while and return how many torques a second were applied [Hz]."""
        before = len(self.applied)
        started = time.monotonic()
        self.listen(duration)
        return (len(self.applied) - before) / (time.monotonic() - started)

    def publisher(self, topic: str) -> Publisher:
        """Return a publisher of the probe's on one of the plant's inputs."""
        return self.conductor.node.create_publisher(JointState, f"{NAMESPACE}/{topic}", qos.COMMAND)

    def attack(self, topic: str, messages: Iterable[JointState | bytes], *, rate: float | None = None) -> int:
        """Publish messages on an input and return how many were sent.

        Args:
            topic: The input.
            messages: What to send.
            rate: Messages per second; None as fast as possible.
        """
        publisher = self.publisher(topic)
        self.wait_for(f"the plant to hear the probe on {topic}", lambda: publisher.get_subscription_count() > 0, 10.0)
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
            self.applied.append(Applied(time.monotonic(), fields.effort, fields.stamp_ns))

    def _on_command(self, data: bytes) -> None:
        fields = decode_joint_state(data)
        if fields is not None and fields.frame_id == f"{NAMESPACE}/controller":
            self.commands.append(time.monotonic())

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = {pair.key: pair.value for pair in status.values}
            self.diagnosed[status.name] = time.monotonic()

    def commander(self) -> str:
        """Return who commands the plant, as its newest diagnostics say."""
        return self.diagnostics.get(f"{NAMESPACE}/simulator: plant", {}).get("commander", "")

    def refused(self, topic: str = names.EFFORT_COMMAND) -> dict[str, int]:
        """Return how many messages on an input the plant has refused so far, by reason, as its diagnostics say."""
        values = self.diagnostics.get(f"{NAMESPACE}/simulator: plant", {})
        prefix = f"{topic}.refused."
        return {key[len(prefix) :]: int(value) for key, value in values.items() if key.startswith(prefix)}
