"""``controller``: answer each state of a plant with a torque."""

from __future__ import annotations

# isort: off
import pendulum_msgs_py.programs.one_thread  # noqa: F401  # before anything that imports numpy
# isort: on

import contextlib
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from pendulum_lqr.controller_interface.controller import (
    CONTROLLERS,
    controller_class,
    controller_names,
    controller_parameters,
    make_controller,
)
from pendulum_lqr.controller_interface.interface import Controller, unwrapped
from pendulum_lqr.controller_interface.sampling import ASSUMED_PERIOD, PeriodWatch, differs, rate_problem
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_lqr.nodes.compiled_controller import CompiledController
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.contract.plant_specs import COMPILED, REALTIME_PRIORITY
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.contract.values import JointSample, Vector
from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import MECHANISM_PRESETS, PRESET_NAMES, load_mechanism
from pendulum_msgs_py.programs.realtime import as_ordinary
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.compiled_answers import AnsweredInput
from pendulum_msgs_py.ros.convert import problem_of_state, sample_from_bytes
from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD, Diagnostics
from pendulum_msgs_py.ros.first_answer import LOCKSTEP_SUBSCRIBERS, FirstAnswer
from pendulum_msgs_py.ros.leaving import wait_until_heard
from pendulum_msgs_py.ros.lifecycle import LifecycleNode
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.running_plant import RunningPlant
from pendulum_msgs_py.ros.simulated_time import live_by_stamps
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["NODE_SPECS", "ControllerNode", "main"]

_SEVERAL = " or ".join(", ".join(controller_names(several=True)).rsplit(", ", 1))
NODE_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec(
        "controller", "lqr", "", "Name of the controller.", choices=tuple(CONTROLLERS), read_only=True,
    ),
    ParameterSpec(
        "plant", "thesis", "", f"Plant to design for: {PRESET_NAMES} or the path of a plant file; of several joints, "
        f"with {_SEVERAL}: {', '.join(MECHANISM_PRESETS)}.", read_only=True,
    ),
    ParameterSpec(
        "period", 0.0, "s", "Sampling period of the loop, which discrete designs and filters need; 0 takes it from the "
        "states.", minimum=0.0, read_only=True,
    ),
    ParameterSpec(
        "state_timeout", 0.05, "s", "Age beyond which a state is refused; not used in simulated time.",
        minimum=0.0, exclusive_minimum=True, read_only=True,
    ),
    ParameterSpec(
        "command_type", "joint_state", "", "joint_state: to our plants; multi_array: std_msgs/Float64MultiArray, to "
        "an effort controller of ros2_control.", choices=("joint_state", "multi_array"), read_only=True,
    ),
    ParameterSpec("autostart", True, "", "Configure and activate at once, without a manager.", read_only=True),
    ParameterSpec(
        "autoactivate", True, "", "With autostart: activate too; false configures, and waits inactive for "
        "~/change_state.", read_only=True,
    ),
    LOCKSTEP_SUBSCRIBERS,
    REALTIME_PRIORITY,
    COMPILED,
)  # fmt: skip
"""Parameters of the node itself, without those of the controller."""

_SAME_PERIOD = 0.02
"""Relative change of the measured period that needs no new design."""
_MULTI_ARRAY_TOPIC = "~/commands"


class ControllerNode(LifecycleNode, PollingNode):
    """Lifecycle node around a controller.

    Unconfigured: parameters are declared. Inactive: the gain is designed and printed, states are read without reply.
    Active: every new state gets one reply. Deactivation, shutdown and signals send zero torque and stop.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("controller", enable_logger_service=True)
        self.exit_code = 0
        self._active = False
        self._loop: ControlLoop | None = None
        kind, plant = self._choose("controller"), self._choose("plant")
        self._own = {spec.name for spec in NODE_SPECS}
        self._plant = load_mechanism(plant)
        self._coordinates = self._plant.coordinates
        self._kind = controller_class(kind, self._plant)
        own = controller_parameters(kind, self._plant)
        self._joints, self._driven = self._coordinates.names, self._coordinates.driven_names
        self._settings = NodeParameters(self, NODE_SPECS + own, self._design, self._swap)
        self._period = self._settings["period"] or ASSUMED_PERIOD
        self._period_measured = False
        if takes_time := self._kind.DESIGNING:
            # A compiler cannot be interrupted: the first Ctrl-C waits for it, and nothing is commanded.
            self.get_logger().info(f"{takes_time}; Ctrl-C waits for it, a second one does not")
        # A bad value at start ends the node with its reason instead of a failed transition.
        self._pending: Controller | None = self._design(self._settings.values)
        self._simulated_time = bool(self.get_parameter("use_sim_time").value)
        self._watch = PeriodWatch(exact=self._simulated_time)
        self._period_known = False
        self._logged_other_rate = False
        self._refusal = ""
        self._logged_notice = ""
        self._now = SteadyWallClock()
        self._full_name = self.get_fully_qualified_name()
        self._logged_refusals = 0
        self._multi_array = self._settings["command_type"] == "multi_array"
        if self._multi_array and self._coordinates.volts:
            raise ParameterError(
                f"command_type is 'multi_array', of efforts, and plant {self._plant.name!r} is driven in volts; "
                "expected 'joint_state'"
            )
        if self._multi_array:
            self._command_publisher = self.create_publisher(Float64MultiArray, _MULTI_ARRAY_TOPIC, qos.COMMAND)
        else:
            self._command_publisher = self.create_publisher(JointState, self._coordinates.topics.command, qos.COMMAND)
        self._first_answer = FirstAnswer(self, self._command_publisher, self._settings["lockstep_subscribers"])
        self._diagnostics = Diagnostics(self, "controller")
        source = self.create_waited_input(JointState, names.JOINT_STATES, qos.NEWEST_STATE, self._on_state)
        refusal = "" if self._settings["compiled"] else "compiled is false"
        if self._multi_array:
            refusal = refusal or "command_type is multi_array"
        answerer = CompiledController(self._pending, self._watch, self._may_lend, refusal)
        self._answers = AnsweredInput(source, self._on_state, answerer, lambda: self.request_descriptor)
        self._answers.compile(
            self._command_publisher, sender=self._full_name, joint=self._driven[0], ahead_ns=self._now.ahead_ns
        )
        self._running_plant = RunningPlant(self, self._plant)
        live_by_stamps(self, lambda: None if self._loop is None else self._loop.newest_stamp_ns)
        # Wall time on purpose: diagnostics must come even while simulated time stands still.
        create_wall_timer(self, DIAGNOSTICS_PERIOD, self._on_timer)
        if self._settings["autostart"]:
            self._autostart()

    def run_due(self) -> float | None:
        """Process states for some milliseconds, or yield to others; return when it is due again [s]."""
        return self._answers.run_due()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Design the controller and print its gain."""
        try:
            controller = self._pending or self._design(self._settings.values)
        except Exception as error:  # noqa: BLE001 - rclpy would swallow it: the log is the only witness
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._pending = None
        self._loop = ControlLoop(
            controller, self._settings["state_timeout"], simulated_time=self._simulated_time, send=self._send
        )
        self.get_logger().info(
            f"{self._settings['controller']} for plant {self._plant.name}: {controller.describe()}, "
            f"limit {_limit(controller)} {self._coordinates.drive_unit}"
        )
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start answering, without memory of before."""
        if self._loop is None:
            return TransitionCallbackReturn.FAILURE
        if self._watch.period is not None and not self._settle_period(self._watch.period):
            return TransitionCallbackReturn.FAILURE
        self._loop.restart()
        self._active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop answering and send zero torque."""
        self._send_zero()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop the design."""
        self._loop = None
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero torque in any state."""
        self._send_zero()
        return super().on_shutdown(state)

    def close(self) -> None:
        """Send zero torque while the context is still valid, and wait for its arrival."""
        self._send_zero()
        wait_until_heard(self._command_publisher)
        self._publish_diagnostics()

    def _may_lend(self) -> ControlLoop | None:
        """Return the answer loop if a reply needs no other work, else None."""
        ready = self._active and self._period_known and (self._first_answer.gone or not self._simulated_time)
        return self._loop if ready else None

    def _on_state(self, data: bytes) -> None:
        if self._simulated_time and self._active and not self._first_answer.may_go():
            return
        sample = sample_from_bytes(data, self._joints)
        if sample is not None and self._watch.add(sample.stamp_ns):
            self._period_known = False
        if not self._active or self._loop is None or not self._may_answer():
            return
        self._loop.answer(sample, self._now(), problem_of_state(data, self._joints) if sample is None else "")

    def _send(self, sample: JointSample, effort: Vector) -> None:
        if self._multi_array:
            self._command_publisher.publish(Float64MultiArray(data=list(effort)))
        else:
            self._command_publisher.publish(
                encode_joints(sample.stamp_ns, self._full_name, self._driven, (), (), effort)
            )

    def _swap(self, controller: Controller) -> None:
        """Take over a successful design; a failed one leaves the old gain in force."""
        if self._loop is None:
            self._pending = controller
            return
        self._loop.replace(controller)
        self.get_logger().info(f"changed while running: {controller.describe()}")

    def _on_timer(self) -> None:
        self._running_plant.poll()
        self._publish_diagnostics()
        if self._loop is None:
            return
        refused = sum(self._loop.refused.values())
        if refused > self._logged_refusals:
            counts = ", ".join(f"{why.value} {count}" for why, count in sorted(self._loop.refused.items()))
            reason = f" ({self._loop.last_reason})" if self._loop.last_reason else ""
            self.get_logger().warning(f"states refused so far: {counts}{reason}")
            self._logged_refusals = refused

    def _choose(self, name: str) -> str:
        """Return the selected controller or plant, before its parameters can be declared."""
        spec = next(spec for spec in NODE_SPECS if spec.name == name)
        given = self._parameter_overrides.get(spec.name)
        return str(spec.check(spec.default if given is None else given.value))

    # A design may take seconds without replies; plants on the same core must not wait for it.
    @as_ordinary()
    def _design(self, values: Mapping[str, Any]) -> Controller:
        # Until the period is known, the loop's stability cannot be checked.
        known = bool(values["period"]) or self._period_measured
        own = {name: value for name, value in values.items() if name not in self._own}
        return make_controller(values["controller"], self._plant, self._period, own, checked=known)

    def _design_for(self, period: float) -> None:
        """Set another period, check the design at it, and use a new one if it depends on it."""
        before, self._period = self._period, period
        if self._loop is None or (self._kind.DESIGNING and not self._uses_period()):
            return
        try:
            designed = self._design(self._settings.values)
        except PendulumError:
            self._period = before
            raise
        if self._uses_period():
            self._loop.replace(designed)
            self.get_logger().info(f"designed for states every {period:g} s: {self._loop.controller.describe()}")

    def _uses_period(self) -> bool:
        return self._kind.SAMPLED or self._settings.values.get("velocity", "measured") != "measured"

    def _may_answer(self) -> bool:
        """Return whether the design is for the rate of the states, as far as that is known."""
        if self._period_known:
            return True
        measured = self._watch.period
        if measured is not None:
            if self._settle_period(measured):
                return True
            self.trigger_deactivate()
            return False
        # A controller that needs an unset period waits for the first few states. In lockstep there is no second state
        # without a reply to the first; and a running controller continues while a plant restarts.
        waits = self._uses_period() and not self._settings["period"] and not self._simulated_time
        return not waits or (self._loop is not None and self._loop.answered > 0)

    def _settle_period(self, measured: float) -> bool:
        """Design for the measured period if none was given; return whether the controller is stable at it."""
        values = self._settings.values
        self._refusal = ""
        plant = self._plant
        try:
            self._period_measured = True
            if not values["period"] and abs(measured / self._period - 1.0) > _SAME_PERIOD:
                self._design_for(measured)
            elif not values["period"] and not self._kind.DESIGNING:
                # Not a slow design, which may take longer than the gap that counts as a plant's restart.
                self._design(values)
            if self._loop is not None:
                unwrapped(self._loop.controller).check(measured)
            if plant.is_pendulum:
                self._refusal = rate_problem(
                    self._kind, values["controller"], lambda: self._design(values), plant, self._period, measured,
                    uses=self._uses_period(), set_point=values["set_point"],
                )  # fmt: skip
        except PendulumError as error:
            self._refusal = f"states come every {measured:g} s: {error}"
        if self._refusal:
            self.get_logger().error(f"not answering: {self._refusal}")
            return False
        self._period_known = True
        return True

    def _autostart(self) -> None:
        if self.trigger_configure() != TransitionCallbackReturn.SUCCESS:
            raise PendulumError("the controller cannot be configured; the log says why")
        if not self._settings["autoactivate"]:
            self.get_logger().info(
                f"waits inactive; when the plant is armed and where it should be: {self._full_name}/change_state"
            )
            return
        if self.trigger_activate() != TransitionCallbackReturn.SUCCESS:
            raise PendulumError("the controller cannot be activated; the log says why")

    def _send_zero(self) -> None:
        was_active, self._active = self._active, False
        if not was_active or self._loop is None:
            return
        if self._multi_array:
            self._command_publisher.publish(Float64MultiArray(data=[0.0] * len(self._driven)))
            return
        # Just after the last command: with the same stamp it would be refused as a duplicate. After a state without a
        # command it would be a command of its own, which enables the torque loop of a plant at rest.
        if (answered := self._loop.answered_ns) is not None:
            nothing = (0.0,) * len(self._driven)
            self._command_publisher.publish(encode_joints(answered + 1, self._full_name, self._driven, (), (), nothing))

    def _publish_diagnostics(self) -> None:
        values: dict[str, object] = {"controller": self._settings["controller"], "plant": self._plant.name}
        level, text = DiagnosticStatus.OK, "inactive"
        if self._loop is not None:
            values["gain"] = self._loop.controller.describe()
            values["effort_limit"] = _limit(self._loop.controller)
            values.update(self._loop.summary(time.monotonic_ns()))
        measured = self._watch.period
        values["loop"] = self._answers.loop
        values["period"] = self._period
        values["measured_period"] = math.nan if measured is None else measured
        other_rate = measured is not None and self._uses_period() and differs(measured, self._period)
        if self._refusal:
            level, text = DiagnosticStatus.ERROR, f"not answering: {self._refusal}"
        if self._active:
            rate = values.get("answer_rate_hz")
            answering = isinstance(rate, float) and (rate > 0.0 or math.isnan(rate))
            text = "answering" if answering else "active, no states"
            level = DiagnosticStatus.OK if answering else DiagnosticStatus.WARN
            if other_rate:
                level = DiagnosticStatus.WARN
                text = f"{text}; states come every {measured:g} s, designed for {self._period:g} s"
                if not self._logged_other_rate:
                    self.get_logger().warning(text)
            self._logged_other_rate = other_rate
        notice = "" if self._loop is None else unwrapped(self._loop.controller).notice
        if notice:
            level = max(level, DiagnosticStatus.WARN)
            text = f"{text}; {notice}"
            if notice != self._logged_notice:
                self.get_logger().warning(notice)
        self._logged_notice = notice
        if self._running_plant.mismatch:
            level = max(level, DiagnosticStatus.WARN)
            text = f"{text}; {self._running_plant.mismatch}"
        self._diagnostics.publish(self._now(), level, text, values)


def _limit(controller: Controller) -> str:
    return ", ".join(f"{limit:g}" for limit in controller.effort_limits)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the controller node and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    return run_node(
        ControllerNode,
        arguments,
        program="pendulum_lqr controller",
        description="Answers each new joint state with a torque.",
        specs=NODE_SPECS + _specs_for_help(arguments),
        example="python -m pendulum_lqr controller --ros-args -r __ns:=/sim -p controller:=lqr -p q:=[100.0,0.01]",
    )


def _specs_for_help(arguments: Sequence[str]) -> tuple[ParameterSpec, ...]:
    """Return the parameters of the controller that the command line names, LQR by default."""
    for argument in arguments:
        name, separator, value = argument.partition(":=")
        if separator and name == "controller" and value in controller_names():
            # The node reports a missing library itself.
            with contextlib.suppress(PendulumError):
                return controller_parameters(value)
    return controller_parameters("lqr")
