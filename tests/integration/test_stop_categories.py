"""Hold-to-run switch and stop categories of both plants, the bridge on an emulated X5-9, over DDS."""

from __future__ import annotations

from contextlib import closing

import pytest
from rclpy.timer import Timer
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_from_message
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup

_STOP_TIME = 0.8
"""[s]"""
_RATE = 25.0
"""Slow, so that this process follows on a busy machine [Hz]."""
_PATIENCE = {"feedback_watchdog": 20, "command_lifetime": 0.5}
_TORQUE = 1.5
"""[N m]"""


def _plants(**limits: float) -> tuple[NodeProgram, ...]:
    return (
        graph.simulator("/lab", rate_hz=2.0 * _RATE, command_timeout=0.5, **limits),
        graph.bridge("/lab", backend="emulator", feedback_rate=_RATE, command_timeout=0.5, **_PATIENCE, **limits),
    )


class Operator(PlantPeer):
    """Commands a plant, holds its switch or does not, and hears what is applied."""

    patience = 120.0

    def __init__(self, plant: NodeProgram) -> None:
        super().__init__("/lab")
        self._plant = plant.executable
        self.applied: list[tuple[int, float]] = []
        self.node.create_subscription(JointState, names.APPLIED_EFFORT, self._on_applied, qos.STATE)
        self.switch = self.node.create_publisher(Bool, names.ENABLE_INPUT, 10)
        self._timer: Timer | None = None

    def _on_applied(self, message: JointState) -> None:
        self.applied.append((stamp_from_message(message.header.stamp), message.effort[0]))

    def hold(self) -> None:
        self._timer = self.node.create_timer(0.1, lambda: self.switch.publish(Bool(data=True)))

    def fall_silent(self) -> None:
        assert self._timer is not None
        self.node.destroy_timer(self._timer)

    def arm(self, on: bool = True) -> SetBool.Response:
        # Arming asks for less than this controller's torque.
        self.torque = None
        response = self.call(SetBool, f"{self._plant}/arm", SetBool.Request(data=on))
        self.torque = _TORQUE
        return response

    def e_stop(self) -> None:
        assert self.call(Trigger, f"{self._plant}/e_stop", Trigger.Request()).success

    def drives(self) -> bool:
        return bool(self.applied) and self.applied[-1][1] > 0.95 * _TORQUE

    def mode(self) -> str:
        return self.diagnostics.get("mode", "")


@pytest.mark.parametrize(
    "plant", _plants(enable_timeout=1.0, armed_at_start=False)[:1] + _plants(enable_timeout=1.0)[1:]
)
def test_a_plant_drives_only_while_the_switch_is_held(
    plant: NodeProgram, processes: ProcessGroup, domain_id: int
) -> None:
    processes.start(plant.package, plant.executable, *plant.ros_arguments())
    with closing(Operator(plant)) as operator:
        operator.until(lambda: operator.states, "the plant")
        refused = operator.arm()
        assert refused.message == "enable switch is not held; expected true on enable_input, all the time"

        for release in (operator.fall_silent, lambda: operator.switch.publish(Bool(data=False))):
            operator.hold()
            operator.until(lambda: operator.arm().success, "a switch that is held")
            operator.until(operator.drives, "torque")
            if release != operator.fall_silent:
                operator.fall_silent()
            release()
            operator.until(lambda: operator.mode() == "disarmed", "the end of driving")
            assert "enable switch is" in operator.diagnostics["reason"]
            operator.until(lambda: operator.applied[-1][1] == 0.0, "zero torque")
            # It holds it again, and commands all the while: that does not arm.
            operator.hold()
            count = len(operator.applied)
            operator.until(lambda: len(operator.applied) > count + 12, "half a second")  # noqa: B023
            assert not any(effort for _, effort in operator.applied[count:])
            operator.fall_silent()


@pytest.mark.parametrize("plant", _plants(stop_time=_STOP_TIME), ids=lambda plant: plant.executable)
def test_an_e_stop_of_category_1_lets_the_torque_fade_within_its_time(
    plant: NodeProgram, processes: ProcessGroup, domain_id: int
) -> None:
    processes.start(plant.package, plant.executable, *plant.ros_arguments())
    with closing(Operator(plant)) as operator:
        operator.until(lambda: operator.states, "the plant")
        assert operator.arm().success
        operator.until(operator.drives, "torque")
        before = len(operator.applied)
        operator.e_stop()
        operator.until(lambda: operator.mode() == "e_stop", "the latch")
        operator.until(lambda: operator.applied[-1][1] == 0.0, "zero torque")
        # What is applied before the request is heard is the whole torque.
        fading = [(stamp, effort) for stamp, effort in operator.applied[before:] if 0.0 < effort < 0.94 * _TORQUE]
        efforts = [effort for _, effort in fading]
        assert efforts == sorted(efforts, reverse=True)
        assert len(set(efforts)) > 5
        assert (fading[-1][0] - fading[0][0]) / 1e9 <= _STOP_TIME
        count = len(operator.applied)
        operator.until(lambda: len(operator.applied) > count + 20, "what follows")
        assert not any(effort for _, effort in operator.applied[count:])
