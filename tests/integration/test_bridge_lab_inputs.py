"""What a lab adds to the running bridge: an e-stop button on a topic, and less torque on a warm motor."""

from __future__ import annotations

import json

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup


class Bench(GraphPeer):
    """A bridge on its emulator, and a button that is heard as long as it is held in the hand."""

    def __init__(self, processes: ProcessGroup, *parameters: str) -> None:
        super().__init__("bench")
        self.applied: list[float] = []
        self.reasons: list[str] = []
        self.states: list[JointState] = []
        self.mode = ""
        self.button: bool | None = False
        self.effort = 0.0
        self.node.create_subscription(JointState, "joint_states", self._on_state, qos.STATE)
        self.node.create_subscription(
            JointState, "applied_effort", lambda message: self.applied.append(message.effort[0]), qos.STATE
        )
        self.node.create_subscription(String, "events", self._on_event, qos.STATE)
        self._effort = self.node.create_publisher(JointState, "effort_command", 1)
        self._button = self.node.create_publisher(Bool, "e_stop_input", 1)
        self.node.create_timer(0.05, self._press)
        arguments = [word for parameter in parameters for word in ("-p", parameter)]
        arguments += ["-p", "feedback_watchdog:=50", "-p", "command_lifetime:=0.6"]
        processes.start("pendulum_hw_bridge", "bridge", "--ros-args", "-p", "backend:=emulator", *arguments)
        self.until(lambda: self.states, "states", 60.0)

    def _on_state(self, message: JointState) -> None:
        self.states.append(message)
        command = JointState(effort=[self.effort], name=["pendulum_joint"])
        command.header.stamp = message.header.stamp
        command.header.frame_id = "bench"
        self._effort.publish(command)

    def _on_event(self, message: String) -> None:
        content = json.loads(message.data)
        if content.get("name") == "plant_mode":
            self.mode = content["mode"]
            self.reasons.append(content.get("reason", ""))

    def _press(self) -> None:
        if self.button is not None:
            self._button.publish(Bool(data=self.button))

    def arm(self) -> str:
        response = self.call(SetBool, "bridge/arm", SetBool.Request(data=True))
        return "" if response.success else response.message

    def reset(self) -> None:
        self.call(Trigger, "bridge/e_stop_reset", Trigger.Request())


def stops(bench: Bench) -> str:
    """Reset the e-stop, and return why the bridge does not arm."""
    bench.reset()
    return bench.arm()


def test_a_button_latches_when_it_is_pressed_or_falls_silent_and_a_warm_motor_gets_less_torque(
    processes: ProcessGroup, domain_id: int
) -> None:
    # The emulated winding is at 22 degC: of 2 N m, (40 - 22) / (40 - 10) are left.
    warm = ("winding_temperature_limit:=40.0", "derating_temperature:=10.0", "effort_limit:=2.0")
    bench = Bench(processes, "e_stop_input_timeout:=1.5", *warm)
    try:
        # It may have been latched before the button was heard, or since: this process is the button, and may be late.
        bench.until(lambda: stops(bench) == "", "the bridge to arm")
        bench.effort = 2.0
        bench.until(lambda: bench.applied and bench.applied[-1] > 1.0, "torque")
        assert max(bench.applied) == pytest.approx(1.2, abs=0.05)

        bench.button = True
        bench.until(lambda: bench.mode == "e_stop", "the press to latch")
        bench.until(lambda: bench.applied[-1] == 0.0, "zero torque")
        assert bench.reasons[-1] == "e-stop button is pressed"
        bench.reset()
        bench.effort = 0.0
        # While it is pressed nothing goes on, whoever resets.
        bench.until(lambda: bench.mode == "e_stop", "the press to latch again")

        bench.button = False
        bench.until(lambda: stops(bench) == "", "the bridge to arm again")
        # Its answer may come before the event, and the mode that is known still be the one before.
        bench.until(lambda: bench.mode == "armed_effort", "word of it")
        bench.button = None
        bench.until(lambda: bench.mode == "e_stop", "silence to latch")
        assert "is silent for" in bench.reasons[-1]
        assert "e-stop" in bench.arm()

        # A second publisher would hide that the first is silent.
        bench.button = False
        second = bench.node.create_publisher(Bool, "e_stop_input", 1)
        bench.until(lambda: "2 publish for the e-stop button" in stops(bench), "the second publisher to be noticed")
        bench.node.destroy_publisher(second)
        bench.until(lambda: stops(bench) == "", "the bridge to arm with one again")
    finally:
        bench.close()
