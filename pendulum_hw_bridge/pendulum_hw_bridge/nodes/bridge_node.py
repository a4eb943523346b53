"""``bridge``: connect a HEBI actuator, or its emulator, to ROS.

A lifecycle node: ``configure`` connects the actuator and reads its settings back, ``activate`` publishes states and
permits arming. ``deactivate``, ``cleanup``, ``shutdown``, SIGINT, SIGTERM and every error end with no torque, then
strategy off.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import BatteryState, JointState, Temperature

from pendulum_hw_bridge.bridge.actuator_loop import ActuatorLoop
from pendulum_hw_bridge.bridge.assembly import assemble
from pendulum_hw_bridge.bridge.bridge import Bridge, Outcome
from pendulum_hw_bridge.bridge.lab_node import specs_of
from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.drive.derating import Derating
from pendulum_hw_bridge.nodes.e_stop_input_node import EStopInputServer
from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorInfo, Feedback
from pendulum_hw_bridge.port.clocks import Clock, SteppedClock, WallClock
from pendulum_hw_bridge.port.feedback_message import encode_feedback
from pendulum_msgs_py.contract.plant_specs import LOCKSTEP_EPOCH_NS
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode
from pendulum_msgs_py.contract.timing import LoopStatistics
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample, Vector
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.plants.lab_file import EMULATED_BACKENDS
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, describe_plants
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_to_message
from pendulum_msgs_py.ros.lifecycle import LifecycleNode
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.plant_loop import LockstepLoop
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["BridgeNode", "main"]

_SLOW_PERIOD = 0.5
_FEEDBACK_QOS = qos.STATE
"""As deep as that of states: in lockstep, half a second of wall time is hundreds of records."""


def _logged(transition: Callable[..., TransitionCallbackReturn]) -> Callable[..., TransitionCallbackReturn]:
    """Log why a transition failed, because rclpy swallows exceptions in transitions."""

    @functools.wraps(transition)
    def guarded(self: BridgeNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(self, state)
        except Exception as error:  # noqa: BLE001  (a transition may fail for any reason)
            return self._fail(transition.__name__, error)

    return guarded


class BridgeNode(LifecycleNode, PollingNode):
    """An actuator as a plant; ``stop`` asks the runner to end the process."""

    loop_type = ActuatorLoop
    """Class of the real-time loop."""

    def __init__(self, stop: Callable[[], None], **options: Any) -> None:
        super().__init__("bridge", enable_logger_service=True, **options)
        self._stop_runner = stop
        self.failure: Exception | None = None
        specs = specs_of(self)
        self._values = values = NodeParameters(self, specs).values
        self._lockstep = values["clock"] == "lockstep"
        self._period_ns = round(NANOSECONDS / values["feedback_rate"])
        self._statistics = LoopStatistics(self._period_ns)
        self._port_clock = self._make_clock()
        self._active = False
        self._loop: ActuatorLoop | None = None
        self._bridge: Bridge | None = None
        # Made here, so that a refused parameter ends the process with its message.
        self._assembly = assembly = assemble(values, specs, lockstep=self._lockstep)
        self._mapping = assembly.mapping
        self._described_plants = describe_plants(assembly.described)
        self._no_effort = (0.0,) * len(assembly.coordinates.driven)
        self._supervisor = SharedSupervisor(
            assembly.limits,
            self._prepare,
            self._withdraw,
            lambda: self._interface.measured(),  # noqa: PLW0108  # made below
            coordinates=assembly.coordinates,
            follows=not assembly.coordinates.volts,
        )
        self._lockstep_loop: LockstepLoop | None = None
        self._interface = PlantInterface(
            self,
            self._supervisor,
            (lambda: self._lockstep_loop.now_ns if self._lockstep_loop else LOCKSTEP_EPOCH_NS)
            if self._lockstep
            else self._port_clock.now_ns,
            push=values["backend"] in EMULATED_BACKENDS,
            polled=True,
            statistics=None if self._lockstep else self._statistics,
            more_diagnostics=self._diagnostics,
            on_command=self._on_command,
            motor_efforts=assembly.described[0].voltage_efforts if assembly.coordinates.volts else None,
        )
        if not self._lockstep:
            self._interface.watch_inputs()
        self._interface.hardware_id = assembly.hardware
        self._e_stop_input: EStopInputServer | None = None
        names = assembly.coordinates.names
        self._several = names if len(names) > 1 else ()
        self._feedback = self.create_publisher(JointState, "actuator/feedback", _FEEDBACK_QOS)
        self._temperature = self.create_publisher(Temperature, "actuator/winding_temperature", _FEEDBACK_QOS)
        self._supply = self.create_publisher(BatteryState, "actuator/supply", _FEEDBACK_QOS)
        if not self._lockstep:
            create_wall_timer(self, _SLOW_PERIOD, self._publish_slow)
        else:
            self._lockstep_loop = LockstepLoop(
                self._interface,
                self._advance,
                self._period_ns,
                [Input(name) for name in values["lockstep_inputs"]],
                subscribers=values["lockstep_subscribers"],
                duration=values["lockstep_duration"],
            )
            self._lockstep_loop.paused = True
        self._derating = Derating(values["derating_temperature"], values["winding_temperature_limit"])
        if values["e_stop_input_timeout"] > 0.0:
            self._e_stop_input = EStopInputServer(
                self,
                values["e_stop_input_timeout"],
                self._interface.e_stop,
                lambda: self._supervisor.mode is Mode.E_STOP,
            )
        if values["autostart"]:
            self._autostart()

    def close(self) -> None:
        """Disarm, remove torque, set strategy off, and publish a last zero torque for recordings."""
        stamp_ns = self._interface.clock()
        self._interface.safe_stop("bridge ends")
        self.release_actuator()
        self._interface.publish_applied(stamp_ns, self._no_effort)
        self._interface.close()
        if self._e_stop_input is not None:
            self._e_stop_input.close()

    def release_actuator(self) -> None:
        """Stop and release the actuator."""
        self._active = False
        if self._lockstep_loop is not None:
            self._lockstep_loop.paused = True
        if self._loop is not None:
            self._loop.close()
        elif self._bridge is not None:
            self._bridge.close()
        self._tell_pending_stop()
        self._loop = None
        self._bridge = None

    def run_due(self) -> float | None:
        """Run the lockstep loop's due step; return the time until the next [s], None in real time."""
        if self._lockstep_loop is not None:
            return self._lockstep_loop.run_due()
        # Count commanders at rest too, when the actuator's thread takes no inputs because no states are published.
        if self._loop is None or not self._loop.active:
            self._interface.wait_for_inputs(0.0)
        return None

    def _make_clock(self) -> Clock:
        return WallClock()

    @_logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Connect the actuator; every setting must read back."""
        values = self._values
        if self._lockstep:
            self._port_clock = SteppedClock(LOCKSTEP_EPOCH_NS)
        self._bridge = bridge = Bridge(self._assembly.modules(self._port_clock), self._supervisor)
        if not self._lockstep:
            self._loop = self.loop_type(
                bridge,
                self._statistics,
                on_state=self._interface.publish_state,
                decide=lambda: self._derated(self._interface.decide()),
                on_outcome=self._on_outcome,
                on_records=self._on_records,
                take_inputs=self._interface.wait_for_inputs,
                answer_window=values["answer_window"],
                report=self.get_logger().error,
            )
        for module, info in zip(bridge.modules, self._call(bridge.connect, timeout=30.0), strict=True):
            self._tell_connected(module, info)
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish states; arming is a separate request."""
        assert self._bridge is not None
        if self._lockstep_loop is not None:
            self._observe_now(self._lockstep_loop.now_ns)
            self._lockstep_loop.paused = False
        if self._loop is not None:
            self._loop.active = True
        self._active = True
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Disarm and stop publishing states."""
        self._quieten("bridge deactivated")
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the actuator."""
        self._quieten("bridge cleaned up")
        self.release_actuator()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the actuator and end the process."""
        self._quieten("bridge shut down")
        self.release_actuator()
        self._stop_runner()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the actuator after an error in a transition."""
        self._quieten("error in a transition")
        self.release_actuator()
        return TransitionCallbackReturn.SUCCESS

    def _fail(self, transition: str, error: Exception) -> TransitionCallbackReturn:
        self.failure = error
        known = isinstance(error, PendulumError)
        self.get_logger().error(str(error) if known else f"{transition}: {type(error).__name__}: {error}")
        self.release_actuator()
        return TransitionCallbackReturn.FAILURE

    def _tell_connected(self, module: Module, info: ActuatorInfo) -> None:
        driven = isinstance(module, DrivenModule)
        self._interface.publish_event(
            "actuator_connected",
            **({"joint": module.joint} if module.joint else {}),
            backend=info.backend,
            family=info.family,
            actuator=info.name,
            serial=info.serial,
            firmware=info.firmware,
            effort_strategy=self._assembly.effort_strategy if driven else "none",
            firmware_strategy=int(self._mapping.strategy) if driven else 0,
            efficiency=self._mapping.efficiency if driven else 0.0,
            feedback_rate=info.feedback_rate,
            command_lifetime=info.command_lifetime,
            drivetrain=dict(info.drivetrain),
        )
        effort = (
            f"command lifetime {info.command_lifetime * 1e3:g} ms, effort by {self._assembly.effort_strategy}"
            if driven
            else "read only"
        )
        self.get_logger().info(
            f"connected to {info.backend} {info.family}/{info.name} ({info.serial}), {info.feedback_rate:g} Hz, "
            f"{effort}"
        )

    def _autostart(self) -> None:
        for step in (self.trigger_configure, self.trigger_activate):
            if step() is not TransitionCallbackReturn.SUCCESS:
                self.release_actuator()
                if isinstance(self.failure, PendulumError):
                    raise self.failure
                raise ActuatorError("exception", f"bridge did not start: {self.failure}")

    def _quieten(self, reason: str) -> None:
        self._active = False
        self._supervisor.disarm(self._interface.clock(), reason)
        if self._lockstep_loop is not None:
            self._lockstep_loop.paused = True
        if self._loop is not None:
            self._loop.active = False
        if self._bridge is not None:
            self._call(self._bridge.release)
            self._tell_pending_stop()
        self._interface.publish_diagnostics()

    def _tell_pending_stop(self) -> None:
        if self._bridge is not None and self._bridge.stop_pending:
            self.get_logger().error(f"{self._bridge.last_fault}: press the motion stop, cut the supply")

    def _prepare(self) -> str:
        if self._e_stop_input is not None and (reason := self._e_stop_input.reason):
            return reason
        if not self._active or self._bridge is None:
            return "bridge is not active; configure and activate it first"
        try:
            return self._call(functools.partial(self._prepare_drive, self._bridge), timeout=2.0)
        except ActuatorError as error:
            return str(error)

    def _prepare_drive(self, bridge: Bridge) -> str:
        """Prepare in the actuator's thread, and use the newest sample from there."""
        refusal = bridge.prepare()
        # In lockstep no time passes meanwhile, and samples have stamps of their own.
        if not self._lockstep:
            self._interface.sample = bridge.sample
        return refusal

    def _withdraw(self) -> None:
        if self._bridge is not None:
            self._call(self._bridge.release)

    def _call(self, job: Callable[[], Any], timeout: float = 5.0) -> Any:
        return job() if self._loop is None else self._loop.call(job, timeout)

    def _on_outcome(self, stamp_ns: int, outcome: Outcome) -> None:
        self._interface.publish_applied(stamp_ns, outcome.effort)

    def _on_records(self, records: tuple[Feedback, ...]) -> None:
        self._feedback.publish(encode_feedback(records, self._several))

    def _on_command(self, kind: Input, command: JointCommand) -> None:
        if self._lockstep_loop is not None:
            self._lockstep_loop.answered(kind, command)
        elif self._loop is not None:
            self._loop.answered(kind, command)

    def _advance(self, drive: Drive, stamp_ns: int) -> tuple[JointSample | None, Vector]:
        """Carry out a decision, advance simulated time to a stamp, and return sample and effort."""
        bridge = self._bridge
        assert bridge is not None
        outcome = bridge.carry_out(self._derated(drive), was_armed=self._supervisor.mode.armed)
        self._port_clock.wait_until(stamp_ns)
        return self._observe_now(stamp_ns), outcome.effort

    def _derated(self, drive: Drive) -> Drive:
        """Return a decision with its torque within the derated limit."""
        bridge = self._bridge
        if bridge is None or not bridge.records or drive.kind is not DriveKind.EFFORT:
            return drive
        effort = tuple(
            self._derating.clamp(effort, limit, module.feedback.winding_temperature)
            for effort, limit, module in zip(drive.effort, self._supervisor.limits.effort, bridge.drives, strict=True)
            if module.feedback is not None
        )
        return drive if effort == drive.effort else drive._replace(effort=effort)

    def _observe_now(self, stamp_ns: int) -> JointSample | None:
        bridge = self._bridge
        assert bridge is not None
        sample = bridge.observe(0.0)
        if sample is None:
            return None
        # Before the first step subscribers may be missing, and two runs must publish the same.
        assert self._lockstep_loop is not None
        if self._lockstep_loop.started:
            self._feedback.publish(encode_feedback(bridge.records, self._several, stamp_ns))
            if (stamp_ns - LOCKSTEP_EPOCH_NS) % round(_SLOW_PERIOD * NANOSECONDS) < self._period_ns:
                self._publish_slow(stamp_ns)
        bridge.sample = sample = sample._replace(stamp_ns=stamp_ns)
        if self._interface.sample is None:
            self._interface.sample = sample
        return sample

    def _publish_slow(self, stamp_ns: int | None = None) -> None:
        """Publish temperature and supply by wall time, in lockstep by simulated time."""
        if self._bridge is None or not self._bridge.records or not self._active:
            return
        feedback = self._hottest(self._bridge)
        stamp = stamp_to_message(feedback.stamp_ns if stamp_ns is None else stamp_ns)
        temperature = Temperature(temperature=feedback.winding_temperature)
        temperature.header.stamp = stamp
        temperature.header.frame_id = "motor_winding"
        self._temperature.publish(temperature)
        supply = BatteryState(
            voltage=feedback.voltage,
            current=-feedback.motor_current,
            temperature=feedback.board_temperature,
            charge=float("nan"),
            capacity=float("nan"),
            design_capacity=float("nan"),
            percentage=float("nan"),
            present=True,
        )
        supply.header.stamp = stamp
        self._supply.publish(supply)

    @staticmethod
    def _hottest(bridge: Bridge) -> Feedback:
        """Return the newest record of the drive with the hottest winding."""
        records = [drive.feedback for drive in bridge.drives if drive.feedback is not None]
        return max(records, key=lambda record: record.winding_temperature)

    def _diagnostics(self) -> Mapping[str, object]:
        bridge = self._bridge
        values: dict[str, object] = {
            "active": self._active,
            PLANT_PARAMETERS: self._described_plants,
            "backend": self._values["backend"],
            "effort_strategy": self._assembly.effort_strategy,
        }
        if self._lockstep_loop is not None:
            values.update(self._lockstep_loop.diagnostics())
        if bridge is None or not bridge.records:
            return values
        feedback = self._hottest(bridge)
        present = next((module.monitor.present for module in bridge.modules if module.monitor.present), None)
        values.update(
            {
                "firmware_strategy": int(bridge.drives[0].port.strategy),
                "winding_temperature_degc": feedback.winding_temperature,
                "torque_share_left": self._derating.share(feedback.winding_temperature),
                "voltage_v": feedback.voltage,
                "pwm": feedback.pwm_command,
                "winding_current_a": feedback.winding_current,
                "last_fault": bridge.last_fault or "none",
                "present_fault": present.name if present is not None else "none",
            }
        )
        if stood_still := getattr(bridge.modules[0].port, "stood_still", 0.0):
            values["machine_stood_still_s"] = stood_still
        values.update({f"faults.{name}": count for name, count in sorted(bridge.faults.items())})
        return values


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bridge, or with ``--check`` the checklist before arming."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if "--check" in arguments:
        from pendulum_hw_bridge.checks.check_cli import main as check

        arguments.remove("--check")
        # With ROS arguments the checklist uses the bridge's own defaults.
        return check(arguments if "--ros-args" in arguments else [*arguments, "--ros-args"])
    return run_node(
        BridgeNode,
        arguments,
        program="pendulum_hw_bridge bridge",
        description="Drives a HEBI X5-9, or its emulator, behind the same interface as the simulator.",
        specs=SPECS,
        example="python -m pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p backend:=emulator",
    )
