"""Two HEBI modules as one plant on the graph: hebi-py's own commands, emulated modules in processes of their own.

The emulated modules are two pendulums beside each other, not one on the other: what is tried is the way of the packets
and what ends torque, not the mechanics.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.udp_address import free_udp_address

pytest.importorskip("hebi", reason="hebi-py is not installed")

GOAL = (math.pi, 0.0)
HELD = 100
"""Torques that are to be applied: a second at 100 Hz, where the computer is not busy."""
PATIENCE = 120.0
"""For a busy computer, on which the plant is armed again and again [s]."""


class Peer(GraphPeer):
    """Hears the plant, and arms it."""

    def __init__(self) -> None:
        super().__init__("peer", namespace="hw")
        self.state: JointState | None = None
        self.applied: list[JointState] = []
        self.diagnostics: dict[str, str] = {}
        self.node.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.STATE)
        self.node.create_subscription(JointState, names.APPLIED_EFFORT, self.applied.append, qos.STATE)
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, 10)

    def _on_state(self, message: JointState) -> None:
        self.state = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": plant"):
                self.diagnostics = {pair.key: pair.value for pair in status.values}

    def known(self) -> str:
        return f"; diagnostics {self.diagnostics}"

    @property
    def mode(self) -> str:
        return self.diagnostics.get("mode", "")

    def arm(self, on: bool) -> SetBool.Response:
        return self.call(SetBool, "bridge/arm", SetBool.Request(data=on))

    def hold(self) -> None:
        """Arm, and wait for torques; again where a busy computer stalled the bridge or the commander."""

        def has_held() -> bool:
            if self.mode in {"fault", "disarmed"}:
                self.arm(False)
                self.diagnostics = {}
                self.arm(True)
            return len(self.torques) >= HELD

        self.until(has_held, "a plant that is held", PATIENCE)

    @property
    def torques(self) -> list[tuple[float, ...]]:
        """Torques that were applied."""
        return [tuple(each.effort) for each in self.applied if any(each.effort)]


@pytest.fixture
def peer(domain_id: int) -> Iterator[Peer]:
    with closing(Peer()) as peer:
        yield peer


def strategy_of(address: str) -> int:
    """Return the strategy of an emulated module."""
    port = EmulatorProcessBackend(address)
    try:
        return int(port.connect().strategy)
    finally:
        port.release()


def test_two_modules_are_held_as_one_plant_and_the_loss_of_one_switches_the_other_off(processes, peer: Peer) -> None:
    addresses = [free_udp_address(), free_udp_address()]
    modules = [
        processes.start(
            "pendulum_hw_bridge", "emulator", "--address", address, "--plant", "x5_9", "--position", str(angle),
            "--family", "Lab", "--name", name, "--serial", serial,
        )
        for address, angle, name, serial in zip(addresses, GOAL, ("z_first", "a_second"), ("S-1", "S-2"), strict=True)
    ]  # fmt: skip
    parameters = [
        "plant:=double_pendulum",
        "backend:=hebi",
        f"interface:=emulator:{','.join(reversed(addresses))}",
        "families:=[Lab]",
        "names:=[z_first, a_second]",
        "serials:=['', S-2]",
        "feedback_watchdog:=10",
        "command_timeout:=0.1",
        "command_lifetime:=0.1",
    ]
    controller = processes.start(
        "pendulum_lqr",
        "controller",
        "--ros-args",
        "-r",
        "__ns:=/hw",
        "-p",
        "plant:=double_pendulum",
        "-p",
        "period:=0.01",
    )
    for module in modules:
        module.wait_for_output("listens on", 60)
    arguments = [item for parameter in parameters for item in ("-p", parameter)]
    bridge = processes.start("pendulum_hw_bridge", "bridge", "--ros-args", "-r", "__ns:=/hw", *arguments)
    bridge.wait_for_output(r"connected to hebi Lab/z_first \(S-1\)(.|\n)*connected to hebi Lab/a_second \(S-2\)", 60)
    controller.wait_for_output("lqr for plant double_pendulum", 60)

    peer.hold()

    assert peer.state is not None
    assert (list(peer.state.name), list(peer.applied[-1].name)) == (["shoulder", "elbow"], ["shoulder", "elbow"])
    assert np.abs(np.array(peer.state.position) - GOAL).max() < 0.1
    assert np.abs(peer.torques).max() < 3.0
    peer.until(lambda: peer.arm(False).success, "the end of driving")
    # The answer comes before the actuator's thread has carried it out.
    peer.until(lambda: [strategy_of(address) for address in addresses] == [0, 0], "both modules off")

    peer.applied.clear()
    peer.hold()
    modules[1].send_signal(signal.SIGINT)
    assert modules[1].wait(20.0) == 0
    peer.until(lambda: peer.mode == "fault" and strategy_of(addresses[0]) == 0, "the fault and the other module off")
    assert not peer.arm(True).success
    for program in (controller, bridge):
        program.send_signal(signal.SIGINT)
    assert controller.wait(20.0) == 0
    bridge.wait(20.0)
    assert strategy_of(addresses[0]) == 0
