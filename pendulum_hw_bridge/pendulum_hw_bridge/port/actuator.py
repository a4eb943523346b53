"""Actuator port: the only interface of the bridge to a drive.

Each backend (HEBI module, emulated X5-9, emulator in another process, replay of a bag) implements
:class:`ActuatorPort`; nothing above depends on which one it is.
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
"""Peak torque of an X5-9. Source: HEBI datasheet [N m]."""
NO_SETPOINT = math.nan
"""Setpoint of a loop that is off, by HEBI's convention."""
MAX_COMMAND_LIFETIME = 5.0
"""Longest command lifetime of the firmware [s]."""


class ActuatorError(FaultError):
    """The actuator cannot do what was requested, or is lost; ``fault`` is a name of the README's fault table."""

    def __init__(self, fault: str, message: str) -> None:
        super().__init__(message)
        self.fault = fault


@contextmanager
def afterwards(action: Callable[[], object]) -> Iterator[None]:
    """Run an action that stops or releases a motor, however the block ends, without hiding the block's error.

    Raises:
        ActuatorError: That of the block, with the action's error appended; or the action's own.
    """
    try:
        yield
    except ActuatorError as error:
        try:
            action()
        # Any error of the action: the fault of the machine comes first.
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
    """Temperature protection of the firmware."""

    NORMAL = 0
    CRITICAL = 1
    EXCEED_MAX_MOTOR = 2
    EXCEED_MAX_BOARD = 3


class LimitState(IntEnum):
    """Position of a quantity relative to its safety limit."""

    BELOW = 0
    AT_LOWER = 1
    INSIDE = 2
    AT_UPPER = 3
    ABOVE = 4
    UNINITIALIZED = 5


class CommandLock(IntEnum):
    """Owner of the command lifetime."""

    UNLOCKED = 0
    LOCKED_BY_OTHER = 1
    LOCKED_BY_SENDER = 2


def state_name(kind: type[IntEnum], number: int) -> str:
    """Return the name of a firmware state, or its number if a newer firmware added it."""
    try:
        return kind(number).name
    except ValueError:
        return f"{number} (unknown)"


class MStopAction(str, Enum):
    """Effect of the motion stop on a module."""

    DISABLED = "disabled"
    MOTOR_OFF = "motor_off"
    HOLD_POSITION = "hold_position"


class Feedback(NamedTuple):
    """One feedback record: everything that the thesis records and that the safety checks need.

    Attributes:
        stamp_ns: Host time of receipt [ns].
        hardware_ns: Actuator time of measurement [ns].
        sequence: Record number; feedback is stale if it does not grow.
        position: Output angle [rad].
        velocity: Output velocity [rad/s].
        effort: Joint torque measured through the spring [N m].
        position_command: Setpoint in force; NaN where the loop is off [rad].
        velocity_command: Setpoint in force [rad/s].
        effort_command: Setpoint in force [N m].
        pwm_command: PWM duty that the firmware applies, -1 to 1 [-].
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
        lock: See :class:`CommandLock`.
        position_limit, velocity_limit, effort_limit: See :class:`LimitState`.
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
    "position": "rad", "velocity": "rad/s", "effort": "N m", "position_command": "rad", "velocity_command": "rad/s",
    "effort_command": "N m", "pwm_command": "-", "motor_current": "A", "winding_current": "A",
    "motor_position": "rad", "motor_velocity": "rad/s", "deflection": "rad", "deflection_velocity": "rad/s",
    "voltage": "V", "winding_temperature": "degC", "housing_temperature": "degC", "motor_sensor_temperature": "degC",
    "board_temperature": "degC", "processor_temperature": "degC",
}  # fmt: skip
"""Physical quantities of a feedback record and their units, in the order of :class:`Feedback`."""


@dataclass(frozen=True, slots=True)
class Command:
    """Setpoints for one command lifetime; a loop whose setpoint is NaN is off.

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
        """Effort field of a packet: the duty under direct PWM [-], else the effort [N m]."""
        return self.effort if math.isnan(self.pwm) else self.pwm


def no_torque(*strategies: Strategy) -> Command:
    """Return setpoints that give no torque under any of the strategies that may be in force.

    Under direct PWM alone that is duty 0. Under all others it is no setpoint at all: effort 0 would enable the torque
    loop, which drives against the torque that the spring holds.
    """
    return Command(pwm=0.0) if set(strategies) == {Strategy.DIRECT_PWM} else Command()


@dataclass(frozen=True, slots=True)
class Applied:
    """Setpoints and strategy that were sent at ``sent_ns`` [ns], and whether a limit changed a setpoint."""

    command: Command
    strategy: Strategy
    limited: bool
    sent_ns: int


@dataclass(frozen=True)
class HardwareLimits:
    """Limits enforced by the firmware, in addition to those of the bridge.

    Attributes:
        effort: Largest effort setpoint [N m].
        velocity: Largest velocity setpoint [rad/s].
        position_min: Lower end of the position window [rad].
        position_max: Upper end [rad].
        pwm: Largest PWM duty [-].
        m_stop: Effect of the motion stop.
        joint: Actuated joint, for the units in messages.
    """

    effort: float = PEAK_EFFORT
    velocity: float = 1.5
    position_min: float = -math.inf
    position_max: float = math.inf
    pwm: float = 1.0
    m_stop: MStopAction = MStopAction.MOTOR_OFF
    joint: Joint = field(default=ONE_JOINT.joints[0], compare=False, repr=False)

    def __post_init__(self) -> None:
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
        """Names and units of the scalar limits."""
        return ("effort", self.joint.effort_unit), ("velocity", self.joint.velocity_unit), ("pwm", "of the supply")


@dataclass(frozen=True)
class ActuatorInfo:
    """Properties that a connected actuator reports.

    Attributes:
        feedback_rate: [Hz].
        command_lifetime: [s].
        gains: Gains in force, or None where the backend cannot read them.
        drivetrain: Constants by name, where known.
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
    """Read-only port without any way to command torque. Methods may be called from one thread only."""

    def connect(self) -> ActuatorInfo:
        """Find the module and return its properties."""

    def now_ns(self) -> int:
        """Return the clock of the feedback stamps [ns]."""

    def read(self, timeout: float) -> Feedback | None:
        """Return the next feedback record, or None after the timeout [s]."""

    def set_feedback_rate(self, rate: float) -> float:
        """Set the feedback rate [Hz] and return the value read back."""

    def close(self) -> None:
        """Release the module; a motor is stopped first."""


@runtime_checkable
class ActuatorPort(EncoderPort, Protocol):
    """One actuator. Methods may be called from one thread only; all raise :class:`ActuatorError`."""

    @property
    def strategy(self) -> Strategy:
        """Strategy in force."""

    def write(self, command: Command) -> Applied:
        """Send setpoints for one command lifetime; return those sent, after limits."""

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Set the strategy, with ``command`` or no torque in the same packet; return the one read back."""

    def set_gains(self, gains: GainSet) -> GainSet:
        """Set the gains of all loops and return those read back."""

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Set the firmware's limits and return those read back."""

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the command lifetime [s], > 0, and return the value read back."""

    def stop(self) -> None:
        """Remove torque, then set strategy off. Safe to call at any time, twice, and after a failure."""
