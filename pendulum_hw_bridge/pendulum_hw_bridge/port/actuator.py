"""The actuator port: everything that the bridge asks of a drive, whichever backend stands behind it.

A backend (HEBI module, emulated X5-9, emulator in another process, replay of a bag) implements
:class:`ActuatorPort`; nothing above this module knows which one it talks to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import NamedTuple, Protocol, runtime_checkable

from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.errors import FaultError, ParameterError

__all__ = [
    "FEEDBACK_QUANTITIES",
    "MAX_COMMAND_LIFETIME",
    "NO_SETPOINT",
    "PEAK_EFFORT",
    "ActuatorError",
    "ActuatorInfo",
    "ActuatorPort",
    "Applied",
    "Command",
    "CommandLock",
    "EncoderPort",
    "Feedback",
    "HardwareLimits",
    "LimitState",
    "MStopAction",
    "Strategy",
    "TemperatureState",
    "afterwards",
    "no_torque",
    "state_name",
]

PEAK_EFFORT = 13.0
"""Peak torque of an X5-9, by its datasheet [N m]."""
NO_SETPOINT = math.nan
"""Setpoint of a loop that is switched off, by HEBI's convention."""
MAX_COMMAND_LIFETIME = 5.0
"""Longest command lifetime that the firmware knows [s]."""


class ActuatorError(FaultError):
    """The actuator cannot do what was asked, or has gone.

    Attributes:
        fault: Name of the fault, as in the README's fault table.
    """

    def __init__(self, fault: str, message: str) -> None:
        super().__init__(message)
        self.fault = fault


@contextmanager
def afterwards(action: Callable[[], object]) -> Iterator[None]:
    """Stop or let go of a motor, whatever ends what is within; an error of that hides none that was before.

    Args:
        action: Such as a port's ``stop``.

    Raises:
        ActuatorError: That of what is within, with what became of the action; or the action's own.
    """
    try:
        yield
    except ActuatorError as error:
        try:
            action()
        # Whatever else went wrong: what was wrong with the machine comes first.
        except Exception as failed:  # noqa: BLE001
            raise ActuatorError(error.fault, f"{error}; and then: {failed}") from error
        raise
    except BaseException:
        action()
        raise
    action()


class Strategy(IntEnum):
    """Control strategies of the firmware.

    ``OFF``: motor off, PWM 0. ``DIRECT_PWM``: the setpoint is the PWM duty. ``TORQUE_CASCADE`` (2): position and
    velocity loops give torque, the effort loop gives PWM. ``PARALLEL_PWM`` (3): three loops, each giving PWM, are
    clipped and added. ``MIXED`` (4): position loop gives torque, velocity loop PWM.
    """

    OFF = 0
    DIRECT_PWM = 1
    TORQUE_CASCADE = 2
    PARALLEL_PWM = 3
    MIXED = 4


class TemperatureState(IntEnum):
    """What the firmware does about its temperature."""

    NORMAL = 0
    CRITICAL = 1
    EXCEED_MAX_MOTOR = 2
    EXCEED_MAX_BOARD = 3


class LimitState(IntEnum):
    """Where a quantity lies with respect to its safety limit."""

    BELOW = 0
    AT_LOWER = 1
    INSIDE = 2
    AT_UPPER = 3
    ABOVE = 4
    UNINITIALIZED = 5


class CommandLock(IntEnum):
    """Who holds the command lifetime."""

    UNLOCKED = 0
    LOCKED_BY_OTHER = 1
    LOCKED_BY_SENDER = 2


def state_name(kind: type[IntEnum], number: int) -> str:
    """Return the name of a state of the firmware; of one that a newer firmware has added, its number."""
    try:
        return kind(number).name
    except ValueError:
        return f"{number} (unknown)"


class MStopAction(str, Enum):
    """What the motion-stop button does to a module."""

    DISABLED = "disabled"
    MOTOR_OFF = "motor_off"
    HOLD_POSITION = "hold_position"


class Feedback(NamedTuple):
    """One complete record of feedback; everything that the thesis records and what a safe bridge has to watch.

    Attributes:
        stamp_ns: Host time of receipt [ns].
        hardware_ns: The actuator's own time of measurement [ns].
        sequence: Number of the record; a number that does not grow means stale feedback.
        position: Output angle [rad].
        velocity: Output velocity [rad/s].
        effort: Joint torque measured through the spring [N m].
        position_command: Setpoint in force; NaN where the loop is off [rad].
        velocity_command: Setpoint in force [rad/s].
        effort_command: Setpoint in force [N m].
        pwm_command: PWM duty that the firmware puts on the motor, -1 to 1 [-].
        motor_current: Current taken from the supply [A].
        winding_current: Estimated winding current [A].
        motor_position: Rotor angle, before the gears [rad].
        motor_velocity: Rotor velocity [rad/s].
        deflection: Output minus motor angle, both at the output: effort = -k deflection [rad].
        deflection_velocity: Its rate [rad/s].
        voltage: Supply voltage [V].
        winding_temperature: Estimated [degC].
        housing_temperature: Estimated [degC].
        motor_sensor_temperature: Measured at the motor [degC].
        board_temperature: Measured on the board [degC].
        processor_temperature: Measured in the processor [degC].
        m_stop: Whether the motion stop is pressed.
        temperature_state: See :class:`TemperatureState`.
        lock: Who holds the command lifetime.
        position_limit: See :class:`LimitState`.
        velocity_limit: See :class:`LimitState`.
        effort_limit: See :class:`LimitState`.
    """

    stamp_ns: int
    hardware_ns: int
    sequence: int
    position: float
    velocity: float
    effort: float
    position_command: float
    velocity_command: float
    effort_command: float
    pwm_command: float
    motor_current: float
    winding_current: float
    motor_position: float
    motor_velocity: float
    deflection: float
    deflection_velocity: float
    voltage: float
    winding_temperature: float
    housing_temperature: float
    motor_sensor_temperature: float
    board_temperature: float
    processor_temperature: float
    m_stop: bool = False
    temperature_state: int = TemperatureState.NORMAL
    lock: int = CommandLock.UNLOCKED
    position_limit: int = LimitState.INSIDE
    velocity_limit: int = LimitState.INSIDE
    effort_limit: int = LimitState.INSIDE


FEEDBACK_QUANTITIES: Mapping[str, str] = {
    "position": "rad",
    "velocity": "rad/s",
    "effort": "N m",
    "position_command": "rad",
    "velocity_command": "rad/s",
    "effort_command": "N m",
    "pwm_command": "-",
    "motor_current": "A",
    "winding_current": "A",
    "motor_position": "rad",
    "motor_velocity": "rad/s",
    "deflection": "rad",
    "deflection_velocity": "rad/s",
    "voltage": "V",
    "winding_temperature": "degC",
    "housing_temperature": "degC",
    "motor_sensor_temperature": "degC",
    "board_temperature": "degC",
    "processor_temperature": "degC",
}
"""Physical quantities of a feedback record and their units, in the order of :class:`Feedback`."""


@dataclass(frozen=True, slots=True)
class Command:
    """Setpoints for one command lifetime; a loop without setpoint (NaN) is off.

    Attributes:
        position: [rad].
        velocity: [rad/s].
        effort: [N m]; not under ``DIRECT_PWM``.
        pwm: Duty, -1 to 1; only under ``DIRECT_PWM``.
    """

    position: float = NO_SETPOINT
    velocity: float = NO_SETPOINT
    effort: float = NO_SETPOINT
    pwm: float = NO_SETPOINT

    @property
    def effort_field(self) -> float:
        """What the effort field of a packet carries: the duty under direct PWM [-], else the effort [N m]."""
        return self.effort if math.isnan(self.pwm) else self.pwm


def no_torque(*strategies: Strategy) -> Command:
    """Return the setpoints that make no torque under a strategy; under each of several where it is uncertain.

    Under direct PWM that is a duty of zero, under every other strategy no setpoint at all: an effort of zero wakes the
    torque loop, which drives against the torque that the spring holds.
    """
    return Command(pwm=0.0) if set(strategies) == {Strategy.DIRECT_PWM} else Command()


@dataclass(frozen=True, slots=True)
class Applied:
    """What a command became: the setpoints that were sent, after limits, and under which strategy.

    Attributes:
        command: The setpoints as sent.
        strategy: Strategy in force.
        limited: Whether a limit changed a setpoint.
        sent_ns: Host time of sending [ns].
    """

    command: Command
    strategy: Strategy
    limited: bool
    sent_ns: int


@dataclass(frozen=True)
class HardwareLimits:
    """Limits that the firmware itself keeps, behind those of the bridge.

    Attributes:
        effort: Largest effort setpoint [N m].
        velocity: Largest velocity setpoint [rad/s].
        position_min: Lower end of the position window [rad].
        position_max: Upper end [rad].
        pwm: Largest PWM duty [-].
        m_stop: What the motion stop does.
        joint: The joint that is moved, whose units messages have.
    """

    effort: float = PEAK_EFFORT
    velocity: float = 1.5
    position_min: float = -math.inf
    position_max: float = math.inf
    pwm: float = 1.0
    m_stop: MStopAction = MStopAction.MOTOR_OFF
    joint: Joint = field(default=ONE_JOINT.joints[0], compare=False, repr=False)

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing."""
        for name, unit in self.units:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} limit is {value} {unit}; expected a finite number > 0")
        if self.pwm > 1.0:
            raise ParameterError(f"pwm limit is {self.pwm}; expected > 0 and <= 1")
        if not self.position_min < self.position_max:
            raise ParameterError(
                f"position window is [{self.position_min}, {self.position_max}] {self.joint.unit}; expected min < max"
            )

    @property
    def units(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the limits that are one number."""
        return ("effort", self.joint.effort_unit), ("velocity", self.joint.velocity_unit), ("pwm", "of the supply")


@dataclass(frozen=True)
class ActuatorInfo:
    """What a connected actuator says of itself, read back and not assumed.

    Attributes:
        backend: Name of the backend.
        family: HEBI family.
        name: HEBI name.
        serial: Serial number.
        firmware: Firmware revision.
        strategy: Strategy in force.
        feedback_rate: [Hz].
        command_lifetime: [s].
        limits: Limits of the firmware.
        gains: Gains in force, or None where the backend cannot read them back.
        drivetrain: Constants by name, where known (for records of a run).
    """

    backend: str
    family: str
    name: str
    serial: str
    firmware: str
    strategy: Strategy
    feedback_rate: float
    command_lifetime: float
    limits: HardwareLimits
    gains: GainSet | None = None
    drivetrain: Mapping[str, float] = field(default_factory=dict)


class EncoderPort(Protocol):
    """What is only read: there is no way to give torque. Methods may be called from one thread only."""

    def connect(self) -> ActuatorInfo:
        """Find the module, and return what it says of itself."""

    def now_ns(self) -> int:
        """Return the clock of the feedback stamps [ns]."""

    def read(self, timeout: float) -> Feedback | None:
        """Return the next feedback record, or None where none came within the timeout [s]."""

    def set_feedback_rate(self, rate: float) -> float:
        """Set the feedback rate [Hz] and return what reads back."""

    def close(self) -> None:
        """Let go of the module; a motor is stopped first."""


@runtime_checkable
class ActuatorPort(EncoderPort, Protocol):
    """One actuator. Methods may be called from one thread only; all raise :class:`ActuatorError`."""

    @property
    def strategy(self) -> Strategy:
        """Strategy in force."""

    def write(self, command: Command) -> Applied:
        """Send setpoints for one command lifetime; return what was really sent, after limits."""

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Change the strategy, with first setpoints in the same packet, and return the one that reads back.

        Without ``command`` there is no torque afterwards.
        """

    def set_gains(self, gains: GainSet) -> GainSet:
        """Set the gains of all loops and return what reads back."""

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Set the firmware's limits and return what reads back."""

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the command lifetime [s], > 0, and return what reads back."""

    def stop(self) -> None:
        """Make it safe: no torque, then strategy off. Safe to call at any time, twice, and after a failure."""
