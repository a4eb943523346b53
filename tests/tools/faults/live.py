"""A running system of real processes on real DDS, a probe that attacks it, and what the probe saw."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from pendulum_bags.experiments.orchestrator_node import Orchestrator
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.experiments.session import (
    ANSWER_PRIORITY,
    LOOP_NICENESS,
    PLANT_PRIORITY,
    RECORDER_PRIORITY,
    permitted,
    start_loop,
)
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_testing.udp_address import free_udp_address
from tests.tools.faults.motor import NO_TORQUE, Asked, Drive, ModuleTruth, Witness, beyond_asked
from tests.tools.faults.plants import EFFORT_LIMIT, SIMULATOR, Plant

__all__ = [
    "EFFORT_LIMIT",
    "MODULE",
    "NAMESPACE",
    "NODES",
    "START_TIMEOUT",
    "Applied",
    "LiveSystem",
    "start_with_priority",
]

START_TIMEOUT = 60.0
NAMESPACE = SIMULATOR.namespace
NODES = SIMULATOR.nodes
"""The nodes of the simulator's system, in the order in which they usually start."""
MODULE = "emulator"
"""Name of the process behind a plant that has a module."""
_RIGHTFUL = {names.EFFORT_COMMAND: "controller", names.DISTURBANCE: "disturbance"}
"""Who may ask for torque, by topic."""
_FALLEN = ("already commands", "firmware_limit", "position is")
"""What a plant says that cannot be armed because its pendulum has fallen, or turned out of its window."""
_FRESH_NS = 60_000_000
"""Age of a command that a plant may still believe [ns]."""
_KEPT_NS = 120_000_000_000
"""How long what the motor did is kept [ns]."""


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


def start_with_priority(processes: ProcessSet, program: NodeProgram) -> Child:
    """Start a node as an experiment does: who keeps deadlines goes first, who only shows goes last."""
    if program.executable in {"viewer", "markers"}:
        return processes.start_node(program)
    keeps_time = program.executable in {"simulator", "bridge"}
    return start_loop(processes, program, PLANT_PRIORITY if keeps_time else ANSWER_PRIORITY)


class LiveSystem:
    """Plant, controller, disturbance and recorder as processes, upright under noise; and a probe among them.

    The probe hears commands and knows what the motor does, so it knows how long torque outlives the last command.

    Args:
        folder: For logs and the bag.
        domain: ROS domain of the system's own.
        plant: Which plant is attacked.
        order: The nodes to start, in this order; none of them is waited for. By default all of the plant's.
        environment: Variables to add for the nodes.
        parameters: ROS parameters to add for a node, by its name.

    Attributes:
        applied: Every torque that the plant said it applied.
        heard: When the last message of controller and disturbance reached the probe, by topic, on the system's
            clock [ns].
        witnessed: Stamps of the controller's commands that came in time [ns].
        asked: What controller and disturbance asked for, by the name of their topic.
        diagnostics: Newest key-value pairs by name of the status, such as ``/sim/simulator: plant``.
        diagnosed: When each status was heard last, on the probe's monotonic clock [s].
    """

    def __init__(
        self,
        folder: Path,
        domain: int,
        plant: Plant = SIMULATOR,
        *,
        order: tuple[str, ...] | None = None,
        environment: Mapping[str, str] | None = None,
        parameters: Mapping[str, Mapping[str, graph.ParameterArgument]] | None = None,
    ) -> None:
        self.folder = folder
        self.domain = domain
        self.plant = plant
        self.children: dict[str, Child] = {}
        self.applied: list[Applied] = []
        self.heard = dict.fromkeys(_RIGHTFUL, 0)
        self.witnessed: list[int] = []
        self.asked = {topic: Witness(EFFORT_LIMIT) for topic in _RIGHTFUL}
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.diagnosed: dict[str, float] = {}
        self._order = plant.nodes if order is None else order
        self._environment = environment or {}
        self._parameters = parameters or {}
        self._bags = 0
        self._modules = 0
        self._truth: ModuleTruth | None = None
        self._drives: list[Drive] = []
        self._taken = 0
        self._address = free_udp_address() if plant.has_module else ""

    def __enter__(self) -> LiveSystem:
        """Start everything and wait until torque flows."""
        logs = self.folder / "logs"
        self.processes = ProcessSet(logs, {**ros_environment(self.domain, logs), **self._environment})
        self.processes.__enter__()
        self.orchestrator = Orchestrator(self.domain, watch=self._hear)
        self.orchestrator.__enter__()
        node, namespace = self.orchestrator.node, self.plant.namespace
        node.create_subscription(
            JointState, f"{namespace}/{names.APPLIED_EFFORT}", self._on_applied, qos.STATE, raw=True
        )
        # The numbers of messages, which tell what was not heard, come with those that are taken by hand alone.
        self._witness = PollingNode("witness", context=self.orchestrator.context, start_parameter_services=False)
        self._inputs = {
            topic: self._witness.create_polled_input(JointState, f"{namespace}/{topic}", qos.COMMAND)
            for topic in _RIGHTFUL
        }
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        self._arming = node.create_client(SetBool, self.service(names.ARM))
        if self.plant.has_module and self._order:
            self.start(MODULE)
        for name in self._order:
            self.start(name)
        if self._order:
            self.bring_back("torque to flow")
        return self

    def __exit__(self, *_: object) -> None:
        """End everything."""
        self.processes.stop()
        self._witness.destroy_node()
        self.orchestrator.__exit__(None, None, None)

    # --- processes -----------------------------------------------------------------------------------------

    def start(self, name: str, **changes: graph.ParameterArgument) -> Child:
        """Start one of the nodes, or start it again."""
        if name == "recorder":
            self._bags += 1
            metadata = self.folder / "metadata.json"
            write_json(metadata, {"pendulum.run": {"experiment": "faults"}})
            priority = permitted(RECORDER_PRIORITY)
            child = start_recorder(self.processes, self.bag, self.plant.namespace, metadata, "mcap", priority=priority)
        elif name == MODULE:
            child = self._start_module()
        else:
            program = self.program(name, **{**self._parameters.get(name, {}), **changes})
            child = start_with_priority(self.processes, program)
        self.children[name] = child
        return child

    def program(self, name: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the description of one of the nodes."""
        namespace = self.plant.namespace
        if name == self.plant.name:
            return self.plant.program(self._address, **changes)
        if name == "controller":
            return graph.controller(namespace, **changes)
        if name == "viewer":
            return NodeProgram("pendulum_sim", "viewer", namespace, parameters={"window": False, "fps": 5.0, **changes})
        return graph.disturbance(namespace, autostart=True, hold_time=0.01, **changes)

    def service(self, name: str) -> str:
        """Return the full name of one of the plant's services, such as ``~/arm``."""
        return name.replace("~", f"{self.plant.namespace}/{self.plant.name}", 1)

    def _start_module(self) -> Child:
        """Start the emulated actuator upright, so that a controller asks for little while it is armed."""
        # What the one before did to its end.
        self.drives()
        self._modules += 1
        path = self.folder / f"truth_{self._modules}.csv"
        command = [sys.executable, "-m", "pendulum_hw_bridge", "emulator", "--address", self._address]
        command += ["--position", "3.1416", "--truth", str(path)]
        child = self.processes.start(f"emulator_{self._modules}", command, niceness=LOOP_NICENESS)
        self._truth = ModuleTruth(path)
        return child

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
        return (name, self.plant.namespace) in self.orchestrator.node.get_node_names_and_namespaces()

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
            self._listen_once(min(0.02, left))

    def wait_for(self, what: str, predicate: Callable[[], bool], timeout: float) -> None:
        """Wait until a predicate holds; raises FaultError with ``what`` otherwise."""
        self.orchestrator.wait_for(what, predicate, timeout)

    def torque_flows(self) -> bool:
        """Tell whether torque was applied within the last 50 ms."""
        now = time.monotonic()
        return any(applied.effort != 0.0 for applied in self.applied[-40:] if now - applied.when < 0.05)

    def hears_all(self) -> bool:
        """Tell whether controller and disturbance were heard within the last 50 ms: the probe knows these processes."""
        return time.time_ns() - min(self.heard.values()) < 50_000_000

    def time_to_zero(self, patience: float = 1.0) -> float:
        """Listen for a while; return the time from the last command to the end of all torque [s].

        By the motor's own clock, from the stamp of the state that the last command answers: no busy machine adds to it.
        """
        self.listen(patience)
        asked = self.asked[names.EFFORT_COMMAND].asked
        last_ns = asked[-1].stamp_ns if asked else 0
        return max(0.0, (self.driven_until_ns(last_ns) - last_ns) * 1e-9)

    def largest_torque(self) -> float:
        """Return the largest torque with which the motor drove lately [N m]."""
        return max((abs(drive.torque) for drive in self.drives()), default=0.0)

    # --- the motor -----------------------------------------------------------------------------------------

    def drives(self) -> list[Drive]:
        """Return what the motor did in the last two minutes, by its own clock."""
        if self._truth is not None:
            self._drives += self._truth.read()
        else:
            self._drives += [Drive(applied.stamp_ns, applied.effort) for applied in self.applied[self._taken :]]
            self._taken = len(self.applied)
        if self._drives and self._drives[-1].time_ns - self._drives[0].time_ns > 2 * _KEPT_NS:
            self._drives = [one for one in self._drives if one.time_ns > self._drives[-1].time_ns - _KEPT_NS]
        return self._drives

    def driven_until_ns(self, since_ns: int) -> int:
        """Return when the motor drove last after an instant, or that instant [ns]."""
        step_ns = 0 if self.plant.has_module else round(self.plant.period * 1e9)
        driven = (one.time_ns + step_ns for one in self.drives() if abs(one.torque) > NO_TORQUE)
        return max([since_ns, *(time_ns for time_ns in driven if time_ns > since_ns)])

    def beyond_asked(self, since_ns: int, until_ns: int) -> Drive:
        """Return by how much the motor drove beyond what was rightfully asked for between two instants [ns, N m].

        The probe must have listened until after the second: what it has not taken yet it does not know.
        """
        drives = [one for one in self.drives() if since_ns <= one.time_ns <= until_ns]
        commands, disturbances = (
            sorted(one for one in witness.asked if one.stamp_ns > since_ns - NANOSECONDS)
            for witness in self.asked.values()
        )
        return beyond_asked(drives, commands, disturbances, EFFORT_LIMIT)

    # --- what a person does ---------------------------------------------------------------------------------

    def mode(self) -> str:
        """Return in which mode the plant is, as its newest diagnostics say."""
        return self.diagnostics.get(f"{self.plant.namespace}/{self.plant.name}: plant", {}).get("mode", "")

    def arm(self, on: bool = True) -> str:
        """Arm or disarm; return why not, or an empty string."""
        answer: Any = self.orchestrator.call(
            self._arming, SetBool.Request(data=on), "the answer to arming", START_TIMEOUT
        )
        return "" if answer.success else str(answer.message)

    def bring_back(self, what: str, *, heard: bool = False) -> None:
        """Wait until torque flows; a plant that was armed once and gave up is armed again, as a person would.

        Args:
            what: Is waited for, for the message.
            heard: Wait until the probe hears the commands too.

        Raises:
            FaultError: It does not come back.
        """
        deadline = time.monotonic() + START_TIMEOUT
        refusal = ""
        while not (self.torque_flows() and (self.hears_all() or not heard)):
            if time.monotonic() > deadline:
                raise FaultError(f"waited {START_TIMEOUT:g} s for {what}, in vain; {refusal or self.mode()}")
            asleep = self.plant.has_module and not self.torque_flows() and self._arming.service_is_ready()
            if asleep and (refusal := self.arm()):
                self.arm(False)
                refusal = self.arm()
                if any(each in refusal for each in _FALLEN):
                    self._begin_upright()
            # Who has just been armed is given time to drive before it is armed anew.
            self.listen(0.5 if asleep else 0.1)

    def _begin_upright(self) -> None:
        """Put the pendulum upright where it has fallen so far that the controller asks for much, or left its window."""
        commanding = [name for name in ("controller", "disturbance") if name in self.children]
        for name in commanding:
            self.processes.finish(self.children.pop(name))
        self.kill(MODULE)
        self.start(MODULE)
        self.arm(False)
        self.wait_for("the module to be armed", lambda: not self.arm(), START_TIMEOUT)
        for name in commanding:
            self.start(name)

    def rate(self, duration: float = 1.0) -> float:
        """Return how many torques a second the plant applies from now on, by its own stamps [Hz].

        Not by when the probe hears of them: after an attack that kept it busy, old ones wait for it.
        """
        since_ns = time.time_ns()
        until_ns = since_ns + round(duration * NANOSECONDS)
        first = len(self.applied)
        deadline = time.monotonic() + duration + START_TIMEOUT
        while time.monotonic() < deadline and not (self.applied and self.applied[-1].stamp_ns >= until_ns):
            self._listen_once(0.02)
        return sum(since_ns <= applied.stamp_ns < until_ns for applied in self.applied[first:]) / duration

    def publisher(self, topic: str) -> Publisher:
        """Return a publisher of the probe's on one of the plant's inputs."""
        return self.orchestrator.node.create_publisher(JointState, f"{self.plant.namespace}/{topic}", qos.COMMAND)

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
                    self._listen_once(0.0005)
            elif sent % 200 == 0:
                self._listen_once(0.0)
        self.listen(0.2)
        self.orchestrator.node.destroy_publisher(publisher)
        return sent

    def flood(self, effort: float) -> Iterable[bytes]:
        """Yield well-formed commands of a stranger, stamped now, for ever."""
        while True:
            yield encode_joint_state(time.time_ns(), frame_id="/stranger", effort=effort)

    def _on_applied(self, data: bytes) -> None:
        fields = decode_joint_state(data)
        if fields is not None and fields.effort:
            self.applied.append(Applied(time.monotonic(), fields.effort[0], fields.stamp_ns))

    def _listen_once(self, duration: float) -> None:
        self.orchestrator.listen(duration)
        self._hear()

    def _hear(self) -> None:
        """Take note of the messages of those who may ask for torque."""
        for topic, polled in self._inputs.items():
            frame = f"{self.plant.namespace}/{_RIGHTFUL[topic]}"
            for data, info in polled.messages():
                fields = decode_joint_state(data)
                if fields is not None and fields.frame_id == frame and fields.effort:
                    asked = Asked(fields.stamp_ns, fields.effort[0])
                    self.asked[topic].hear(asked, info["publication_sequence_number"])
                    self.heard[topic] = info["received_timestamp"]
                    if topic == names.EFFORT_COMMAND and abs(info["received_timestamp"] - asked.stamp_ns) < _FRESH_NS:
                        self.witnessed.append(asked.stamp_ns)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = {pair.key: pair.value for pair in status.values}
            self.diagnosed[status.name] = time.monotonic()

    def commander(self) -> str:
        """Return who commands the plant, as its newest diagnostics say."""
        return self.diagnostics.get(f"{self.plant.namespace}/{self.plant.name}: plant", {}).get("commander", "")

    def refused(self, topic: str = names.EFFORT_COMMAND) -> dict[str, int]:
        """Return how many messages on an input the plant has refused so far, by reason, as its diagnostics say."""
        values = self.diagnostics.get(f"{self.plant.namespace}/{self.plant.name}: plant", {})
        prefix = f"{topic}.refused."
        return {key[len(prefix) :]: int(value) for key, value in values.items() if key.startswith(prefix)}
