"""Bridge between the supervisor of a plant and its modules, in cycles and without ROS.

A cycle is ``observe`` (feedback of all modules, checks), then ``act`` (carry out the supervisor's decision). Driving
always ends through ``release``: no torque, then strategy off. A fault of any module releases all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.drive.fault_table import Fault
from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorInfo, Applied, Feedback
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Mode, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample, Vector
from pendulum_msgs_py.errors import ParameterError, PendulumError

__all__ = ["Bridge", "Outcome"]

_PREPARED_NS = NANOSECONDS
_STOP_AGAIN_NS = NANOSECONDS // 10
"""Interval of stop requests to modules that did not confirm that they are off [ns]."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a cycle.

    Attributes:
        drive: The supervisor's decision.
        effort: Effort of the setpoints of each driven joint, after all limits [N m or N].
        applied: Setpoints sent to each of them; empty if none were.
        fault: Name of the fault that ended driving in this cycle, or an empty string.
    """

    drive: Drive
    effort: Vector
    applied: tuple[Applied, ...] = ()
    fault: str = ""


class Bridge:
    """Carries out a supervisor's decisions on modules, one per joint in the model's order and all on one clock.

    Raises:
        ParameterError: The modules do not match the supervisor's joints and motors.
    """

    def __init__(self, modules: Sequence[Module], supervisor: PlantSupervisor) -> None:
        self.modules = tuple(modules)
        self.drives = tuple(module for module in self.modules if isinstance(module, DrivenModule))
        self.supervisor = supervisor
        self.sample: JointSample | None = None
        self.faults: dict[str, int] = {}
        self.last_fault = ""
        self._clock = self.modules[0].port
        self._nothing = (0.0,) * len(self.drives)
        self._prepared_until_ns = 0
        self._turn_ns: int | None = None
        self._stop_again_ns: int | None = None
        self._check_joints()

    def now_ns(self) -> int:
        """Return the clock of the feedback stamps [ns]."""
        return self._clock.now_ns()

    @property
    def records(self) -> tuple[Feedback, ...]:
        """Newest record of each module; empty before all have sent one."""
        records = tuple(module.feedback for module in self.modules if module.feedback is not None)
        return records if len(records) == len(self.modules) else ()

    def connect(self) -> tuple[ActuatorInfo, ...]:
        """Connect all modules, switch off, write all settings; ActuatorError if missing or not reading back."""
        return tuple(module.connect() for module in self.modules)

    def prepare(self) -> str:
        """Write all settings and the effort strategy at zero torque before arming; return why not, or "".

        A module that lost power has silently lost its settings. Without arming within a second the strategy goes off
        again.
        """
        # A drive disarmed in this very cycle is still in force: stop it before anything is written.
        if self._driving or self.stop_pending:
            self.release()
        self.supervisor.end_stop()
        if self.stop_pending:
            return "the module has not confirmed that it is off"
        refusal = self._present_fault()
        if refusal:
            return refusal
        try:
            for module in self.modules:
                module.write_settings()
            for drive in self.drives:
                drive.idle()
            # Writing takes time on a network; only feedback from afterwards counts.
            self._turn_ns = now = self.now_ns()
            if any(module.monitor.age(now) > module.monitor.period for module in self.modules):
                self.observe(self._timeout)
        except PendulumError as error:
            if self._driving:
                self.release()
            return str(error)
        refusal = self._present_fault()
        if refusal or not self._all_driving:
            self.release()
            return refusal or f"released again: {self.last_fault}"
        self._prepared_until_ns = self.now_ns() + _PREPARED_NS
        return ""

    def release(self) -> None:
        """Remove torque, then set strategy off, on every module whatever another does; never raises.

        Modules that do not confirm are asked again.
        """
        self._tell(self._stop_all())

    def insist(self) -> None:
        """Repeat the stop for modules that have not confirmed that they are off; never raises."""
        if self._stop_again_ns is not None and self.now_ns() >= self._stop_again_ns:
            self.release()

    def close(self) -> None:
        """Stop and release all modules; never raises."""
        errors = self._stop_all()
        self.supervisor.disarm(self.now_ns(), "bridge closes")
        self._tell(errors)
        for module in self.modules:
            try:
                module.port.close()
            except Exception as error:  # noqa: BLE001
                self._note(getattr(error, "fault", "exception"))

    def observe(self, timeout: float) -> JointSample | None:
        """Return the new state of the plant, waiting up to ``timeout`` [s] per module; None while a record is missing.

        On a fault all drives are released before this returns.
        """
        for module in self.modules:
            self._look_at(module, timeout)
        records = self._fresh_records()
        if not records:
            return None
        states = [module.state(records[index]) for index, module in enumerate(self.modules)]
        position, velocity, effort = (tuple(state[part] for state in states) for part in range(3))
        # The stamp is that of the oldest record.
        self.sample = JointSample(min(record.stamp_ns for record in records), position, velocity, effort)
        return self.sample

    def act(self) -> Outcome:
        """Carry out the supervisor's decision for now."""
        now = self.now_ns()
        was_armed = self.supervisor.mode.armed
        return self.carry_out(self.supervisor.decide(now, self.sample), was_armed=was_armed)

    def carry_out(self, drive: Drive, *, was_armed: bool = False) -> Outcome:
        """Carry out a decision; ``was_armed`` before it, to count faults of the supervisor."""
        for index, module in enumerate(self.modules):
            push = getattr(module.port, "push", None)
            if push is not None:
                push(drive.push[index])
        if self._driving and not self._turn():
            return self._ended(drive, "host_stalled")
        if drive.kind is DriveKind.OFF or not self.records:
            return self._rest(drive, was_armed)
        if not self._all_driving:
            # Released between preparing and arming: settings may be lost, or a fault may have passed unseen.
            why = f": {self.last_fault}" if self.last_fault else ""
            self.fail("not_prepared", f"drive was released before it was armed{why}; disarm, then arm again")
            return self._ended(drive, "not_prepared")
        self._prepared_until_ns = 0
        applied = []
        for index, module in enumerate(self.drives):
            assert module.feedback is not None
            try:
                applied.append(module.carry_out(drive, index, module.feedback))
            except ActuatorError as error:
                self.fail(error.fault, module.words(str(error)))
                return self._ended(drive, error.fault)
        # Stored setpoints wait for the last joint's computation: after a stall they belong to a state long gone.
        if not self._turn():
            return self._ended(drive, "host_stalled")
        try:
            self._flush()
        except ActuatorError as error:
            self.fail(error.fault, str(error))
            return self._ended(drive, error.fault)
        return Outcome(drive, tuple(module.effort for module in self.drives), tuple(applied))

    def fail(self, name: str, message: str) -> None:
        """Release all drives at once and set the plant's fault state; ``name`` is one of :data:`FAULTS`."""
        armed = self.supervisor.mode.armed
        if armed or self._driving:
            # Another thread may hold the supervisor's lock: the drives must not wait for it.
            errors = self._stop_all()
            self._note(name)
            self.last_fault = name
            # Report this fault before a failed stop, which would hide it.
            if armed:
                self.supervisor.fault(f"{name}: {message}", self.now_ns())
            self._tell(errors)

    def _stop_all(self) -> list[tuple[DrivenModule, Exception]]:
        """Stop all drives; return the errors, whose report can wait."""
        errors = [(drive, error) for drive in self.drives if (error := drive.stop()) is not None]
        self._stop_again_ns = self.now_ns() + _STOP_AGAIN_NS if errors else None
        return errors

    def _tell(self, errors: Sequence[tuple[DrivenModule, Exception]]) -> None:
        """Set the plant's fault state, because drives have not confirmed that they are off."""
        for drive, error in errors:
            name = self._note(getattr(error, "fault", "exception"))
            self.last_fault = self.last_fault or name
            self.supervisor.fault(f"{name}: {drive.words(str(error))}", self.now_ns())

    @property
    def stop_pending(self) -> bool:
        """Whether a module has not confirmed yet that it is off."""
        return self._stop_again_ns is not None

    @property
    def _timeout(self) -> float:
        """Age at which feedback counts as lost; all modules have one rate [s]."""
        return self.modules[0].monitor.timeout

    @property
    def _driving(self) -> bool:
        return any(drive.driving for drive in self.drives)

    @property
    def _all_driving(self) -> bool:
        return all(drive.driving for drive in self.drives)

    @property
    def _awake(self) -> bool:
        return self._driving or self.supervisor.mode.armed

    def _flush(self) -> None:
        """Send stored setpoints of all ports together."""
        for module in self.drives:
            flush = getattr(module.port, "flush", None)
            if flush is not None:
                flush()
        for module in self.drives:
            module.monitor.left(self.now_ns())

    def _check_joints(self) -> None:
        coordinates = self.supervisor.coordinates
        driven = tuple(index for index, module in enumerate(self.modules) if isinstance(module, DrivenModule))
        names = tuple(module.joint for module in self.modules)
        if len(self.modules) != len(coordinates.joints) or driven != coordinates.driven:
            raise ParameterError(
                f"there are {len(self.modules)} modules, with motors at {list(driven)}; expected "
                f"{len(coordinates.joints)}, with motors at {list(coordinates.driven)}"
            )
        if len(names) > 1 and names != coordinates.names:
            raise ParameterError(f"modules are those of {list(names)}; expected {list(coordinates.names)}")

    def _look_at(self, module: Module, timeout: float) -> None:
        """Wait for a module's next new record and check it, or its silence."""
        if self._driving:
            self._turn()
        try:
            feedback = module.port.read(timeout)
        except ActuatorError as error:
            self.fail(error.fault, module.words(str(error)))
            return
        if self._driving:
            self._turn()
        if feedback is None or not module.monitor.is_new(feedback):
            fault = module.monitor.silence(self.now_ns())
        else:
            fault = module.take(feedback)
            if fault is not None and not self._awake:
                self._understand(module, fault)
        if fault is not None and self._awake:
            self.fail(fault.name, module.words(fault.message))

    def _fresh_records(self) -> tuple[Feedback, ...]:
        """Return one new record of each module, all of one cycle; empty while one is missing."""
        records = self.records
        if not records:
            return ()
        newest = max(record.stamp_ns for record in records)
        for index, module in enumerate(self.modules):
            if newest - records[index].stamp_ns > round(0.5 * module.monitor.period * NANOSECONDS):
                module.fresh = False
        if not all(module.fresh for module in self.modules):
            return ()
        for module in self.modules:
            module.fresh = False
        return records

    def _understand(self, module: Module, fault: Fault) -> None:
        """Record a fault of a plant at rest, which may explain why driving ended."""
        if fault.name == "module_restarted":
            self._note(fault.name)
        elif fault.name == "feedback_late" and self.last_fault == "feedback_lost":
            # Only now can late be distinguished from lost.
            self.last_fault = self._note(fault.name)
            if self.supervisor.mode is Mode.FAULT and self.supervisor.reason.startswith("feedback_lost: "):
                self.supervisor.reason = f"{fault.name}: {module.words(fault.message)}"

    def _turn(self) -> bool:
        """Record that the bridge runs; while it drives, a stall longer than the watchdog's time is a fault."""
        last, self._turn_ns = self._turn_ns, self.now_ns()
        pause = 0.0 if last is None else (self._turn_ns - last) / NANOSECONDS
        timeout = self._timeout
        stalled = pause > timeout
        if stalled:
            self.fail(
                "host_stalled",
                f"bridge did not run for {pause * 1e3:.0f} ms; expected at most {timeout * 1e3:.0f} ms: "
                "is the machine too busy?",
            )
        return not stalled

    def _ended(self, drive: Drive, fault: str) -> Outcome:
        return Outcome(Drive(DriveKind.OFF, effort=self._nothing, push=drive.push), self._nothing, fault=fault)

    def _rest(self, drive: Drive, was_armed: bool) -> Outcome:
        fault = ""
        now = self.now_ns()
        if was_armed and self.supervisor.mode is Mode.FAULT:
            fault = self.last_fault = self._note("supervisor")
        # Prepared for arming, it may wait, but not under an e-stop.
        waits = now <= self._prepared_until_ns and self.supervisor.mode is Mode.DISARMED
        ends = self._driving and (was_armed or not waits)
        if ends:
            self.release()
        self.insist()
        return Outcome(drive, self._nothing, fault=fault)

    def _present_fault(self) -> str:
        for module in self.modules:
            if module.feedback is None:
                return module.words("no feedback yet")
            fault = module.monitor.silence(self.now_ns()) or module.monitor.present
            if fault is not None:
                return f"{fault.name}: {module.words(fault.message)}"
        return ""

    def _note(self, fault: str) -> str:
        self.faults[fault] = self.faults.get(fault, 0) + 1
        return fault
