"""However a controller is activated on an armed plant, its first torque is near zero: one rule for both plants."""

from __future__ import annotations

import math
from contextlib import closing

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from pendulum_bags.experiments.run_spec import EMULATOR_PATIENCE
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.ros import qos
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup

_PLANTS = (
    graph.simulator("/lab", rate_hz=100.0),
    graph.bridge("/lab", backend="emulator", **EMULATOR_PATIENCE),
)
_REFUSED = "expected at most 2.0 N m to begin: bring the plant to where it asks for less"
_BOTTOM = -math.pi
"""Set point at which the hanging pendulum asks for nothing [rad]."""


class Operator(PlantPeer):
    """Client of a plant and its controller that hears what is applied, and why."""

    patience = 120.0

    def __init__(self) -> None:
        super().__init__("/lab")
        self.leave_the_command()
        self.applied: list[float] = []
        self.node.create_subscription(
            JointState, names.APPLIED_EFFORT, lambda message: self.applied.append(message.effort[0]), qos.STATE
        )

    def change(self, transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert self.call(ChangeState, "controller/change_state", request).success

    def hold(self, set_point: float) -> None:
        parameter = Parameter("set_point", value=set_point).to_parameter_msg()
        done = self.call(SetParameters, "controller/set_parameters", SetParameters.Request(parameters=[parameter]))
        assert done.results[0].successful, done.results[0].reason

    def is_refused(self) -> bool:
        return _REFUSED in self.diagnostics.get("reason", "")

    def is_commanded(self) -> bool:
        return self.diagnostics.get("reason", "").startswith("commanded by")


@pytest.mark.parametrize("plant", _PLANTS, ids=lambda plant: plant.executable)
def test_no_way_to_activate_a_controller_gives_a_large_torque_at_once_where_the_simulator_gave_13_n_m(
    plant: NodeProgram, processes: ProcessGroup, domain_id: int
) -> None:
    processes.start(plant.package, plant.executable, *plant.ros_arguments())
    controller = processes.start(
        "pendulum_lqr", "controller", *graph.controller("/lab", autoactivate=False, period=0.01).ros_arguments()
    )
    with closing(Operator()) as lab:
        lab.until(lambda: lab.states, "the plant")
        armed = lab.call(SetBool, f"{plant.executable}/arm", SetBool.Request(data=True))
        assert armed.success, armed.message

        # At the bottom the controller for upright asks for all it has.
        lab.change(Transition.TRANSITION_ACTIVATE)
        lab.until(lab.is_refused, "the refusal")

        # Deactivated and activated again at once, with another set point meanwhile.
        lab.change(Transition.TRANSITION_DEACTIVATE)
        lab.hold(_BOTTOM)
        lab.change(Transition.TRANSITION_ACTIVATE)
        lab.until(lab.is_commanded, "the controller that asks for little")
        lab.change(Transition.TRANSITION_DEACTIVATE)
        lab.hold(_BOTTOM + 0.5)
        lab.change(Transition.TRANSITION_ACTIVATE)
        lab.until(lab.is_refused, "the refusal of a step at activation")

        # Started again under its name.
        controller.interrupt()
        assert controller.wait(60.0) == 0
        processes.start("pendulum_lqr", "controller", *graph.controller("/lab", period=0.01).ros_arguments())
        lab.until(lambda: not lab.is_refused(), "the silence")
        lab.until(lab.is_refused, "the refusal of the new one")
        assert max(map(abs, lab.applied)) < 0.5


def test_a_simulator_without_the_limit_says_so_on_the_log_and_in_diagnostics(
    processes: ProcessGroup, domain_id: int
) -> None:
    plant = graph.simulator("/lab", rate_hz=100.0, start_effort_limit=0.0)
    program = processes.start(plant.package, plant.executable, *plant.ros_arguments())
    with closing(Operator()) as lab:
        lab.until(lambda: lab.diagnostics.get("start_effort_limit") == "inf", "its diagnostics")
        processes.start("pendulum_lqr", "controller", *graph.controller("/lab", period=0.01).ros_arguments())
        lab.until(lambda: any(abs(effort) > 10.0 for effort in lab.applied), "the torque that was asked for")
    assert "start_effort_limit is 0: a commander may begin with any torque" in program.output
