"""Emulated drives behind their vendors' libraries, in simulated time: the same packets, without a line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_hw_bridge.backends.dynamixel import MODELS, DynamixelBackend
from pendulum_hw_bridge.bridge.assembly import for_plant
from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.bridge_parameters import supervisor_limits
from pendulum_hw_bridge.bridge.drive_assembly import DriveAssembly
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.emulation.dynamixel_servo import EmulatedServo, ServoLine
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.contract.supervisor import DriveKind, Input, Mode, PlantSupervisor
from pendulum_msgs_py.contract.values import JointCommand, Vector
from pendulum_msgs_py.plants.plant_parameters import load_mechanism

__all__ = ["DriveRig", "SteppedServo", "WatchedClock", "loop_port"]

MILLISECOND = 1_000_000


def loop_port(line: ServoLine, clock: SteppedClock) -> Any:
    """Return the SDK's port handler on a line in simulated time: waiting for a reply advances the clock."""
    import dynamixel_sdk

    class LoopPort(dynamixel_sdk.PortHandler):
        waiting = b""

        def openPort(self) -> bool:  # noqa: N802
            self.is_open = True
            return True

        def closePort(self) -> None:  # noqa: N802
            self.is_open = False

        def clearPort(self) -> None:  # noqa: N802
            line.take(clock.now_ns())
            self.waiting = b""

        def getCurrentTime(self) -> float:  # noqa: N802
            return clock.now_ns() * 1e-6

        def writePort(self, packet: list[int]) -> int:  # noqa: N802
            if any(ActuatorFault.SEND_FAILED in servo.faults for servo in line.servos.values()):
                raise OSError("[Errno 5] Input/output error")
            line.receive(bytes(packet), clock.now_ns())
            return len(packet)

        def readPort(self, length: int) -> bytes:  # noqa: N802
            if not self.waiting:
                end = round((self.packet_start_time + self.packet_timeout) * 1e6) + 1
                due = min(end, line.output[0][0]) if line.output else end
                clock.wait_until(due)
                self.waiting = line.take(clock.now_ns())
            taken, self.waiting = self.waiting[:length], self.waiting[length:]
            return taken

    return LoopPort("loop")


class WatchedClock(SteppedClock):
    """Simulated time in steps of a millisecond, each of which calls ``watch``."""

    def __init__(self, start_ns: int) -> None:
        super().__init__(start_ns)
        self.watch: Callable[[], None] = lambda: None

    def wait_until(self, time_ns: int) -> None:
        """Let time pass, watched."""
        while (now := self.now_ns()) < time_ns:
            super().wait_until(min(time_ns, now + MILLISECOND))
            self.watch()


class SteppedServo:
    """An emulated servo of a model on a plant in simulated time, and a backend that is not connected yet."""

    backend = "dynamixel"

    def __init__(self, plant: str = "xl330", *, position: float | Vector = 0.0, model: str = "XL330-M288") -> None:
        self.clock = WatchedClock(10**9)
        self.machine = EmulatedMachine(
            load_mechanism(plant),
            position=position if isinstance(position, tuple) else (position,),
            start_ns=self.clock.now_ns(),
            rate=1.0,
        )
        made = MODELS[model]
        self.servo = EmulatedServo(
            self.machine, model=made.number, current_step=made.current_step, torque_per_ampere=made.torque_per_ampere
        )
        self.line = ServoLine([self.servo])
        self.port = DynamixelBackend(1, lambda: loop_port(self.line, self.clock), self.clock, model=model)
        self.faults = self.servo.faults

    @property
    def is_on(self) -> bool:
        """Whether the drive gives torque."""
        return self.servo.torque_on

    @property
    def expiries(self) -> int:
        """How often its watchdog has ended the torque."""
        return self.servo.expiries

    def advance(self) -> None:
        """Let drive and pendulum run up to now."""
        self.line.advance(self.clock.now_ns())

    def restart(self) -> None:
        """Interrupt the drive's supply."""
        self.servo.restart(self.clock.now_ns())

    def fail(self) -> None:
        """Let the drive switch itself off, too hot."""
        self.servo.fail(0x04, self.clock.now_ns())

    def switch_off(self) -> None:
        """Let another program switch the drive off."""
        self.servo.write(64, bytes(1), self.clock.now_ns())


class DriveRig:
    """A bridge on an emulated drive in simulated time, armed upright under a controller.

    Attributes:
        torques: Time and torque of the motor, each millisecond [ns, N m].
    """

    def __init__(self, drive: SteppedServo, *, armed: bool = True) -> None:
        self.drive, self.clock = drive, drive.clock
        defaults = BACKENDS[drive.backend].defaults
        specs = for_plant(SPECS, str(defaults["plant"]), drive.backend)
        values: dict[str, Any] = {spec.name: spec.default for spec in specs}
        values |= {"backend": drive.backend, "interface": "loop"}
        plant = load_mechanism(values["plant"])
        self.period = 1.0 / values["feedback_rate"]
        self.limits = supervisor_limits(values, plant.command_limits, push=plant.effort_limits)
        self.supervisor = PlantSupervisor(self.limits)
        drive.port._joint = ""
        self.module = DriveAssembly(values, plant, self.limits).module(drive.port, 0)
        self.bridge = Bridge([self.module], self.supervisor)
        self.gain = (2.0 * plant.gravity + plant.inertia * 400.0, plant.inertia * 28.0)
        self.controlling, self.alive = True, True
        self.push = 0.3 * self.limits.effort[0]
        self.torques: list[tuple[int, float]] = []
        self.spoil: Callable[[float], float] = lambda effort: effort
        self.bridge.connect()
        self.clock.watch = self._watch
        self.run(0.05)
        if armed:
            assert (refusal := self.arm()) == "", refusal
            self.run(0.3)
            assert self.supervisor.mode is Mode.EFFORT, self.supervisor.reason

    def arm(self) -> str:
        """Arm; return why not, or an empty string."""
        return self.bridge.prepare() or self.supervisor.arm(self.clock.now_ns(), self.bridge.sample)

    def run(self, duration: float) -> None:
        """Let time pass [s]; a bridge that is not alive does nothing."""
        end = self.clock.now_ns() + round(duration * 1e9)
        while self.clock.now_ns() < end:
            if not self.alive:
                self.clock.wait_until(end)
                return
            sample = self.bridge.observe(0.005)
            if sample is not None and self.controlling:
                away = from_upright(sample.position[0])
                # Upright and at rest no torque is needed, and no fault of it would show.
                push = self.push if self.clock.now_ns() // (100 * MILLISECOND) % 2 else -self.push
                effort = self.spoil(-self.gain[0] * away - self.gain[1] * sample.velocity[0] + push)
                command = JointCommand.of_one(sample.stamp_ns, effort, "lqr")
                self.supervisor.offer(Input.EFFORT_COMMAND, command, self.clock.now_ns())
            if sample is not None:
                self.supervisor.report_applied(self.bridge.act().effort)
            else:
                # As the actuator's loop does between two records.
                decision = self.supervisor.decide(self.clock.now_ns(), self.bridge.sample)
                if decision.kind is DriveKind.OFF or decision.starved:
                    self.bridge.carry_out(decision, was_armed=self.supervisor.mode.armed)

    def _watch(self) -> None:
        self.drive.advance()
        self.torques.append((self.clock.now_ns(), self.drive.machine.state[2][0]))
