"""Drives with a current loop: torque is commanded directly, and the measured effort must follow it; and amplifiers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping
from pendulum_hw_bridge.drive.fault_table import Fault
from pendulum_hw_bridge.drive.motor_state import MotorState
from pendulum_hw_bridge.drive.output_check import OutputCheck
from pendulum_hw_bridge.port.actuator import Command, Feedback, Strategy
from pendulum_hw_bridge.port.gains import GainSet

__all__ = ["CurrentCheck", "CurrentMapping", "VoltageMapping"]

_RECORDS = 4
_WRONG = 3
"""Wrong records of ``_RECORDS`` that make a fault: single packets may get lost."""
_SHARE = 0.1
"""Tolerance of the measured effort, as a share of the effort limit [-]."""


@dataclass(frozen=True)
class CurrentMapping(EffortMapping):
    """Identity within the effort limit; an older setpoint may still show in ``late`` records, by a delay [-].

    Such drives get a torque alone, so position control is computed here: ``stiffness`` [N m/rad] and ``viscosity``
    [N m s/rad] on the newest record; 0 for none.
    """

    late: int = 0
    stiffness: float = 0.0
    viscosity: float = 0.0

    def follow(self, command: Command, feedback: Feedback) -> tuple[Strategy, Command]:
        """Return the torque that leads to a position and a velocity; none without a stiffness."""
        lead = self.stiffness * (command.position - feedback.position)
        return self.strategy, Command(effort=lead + self.viscosity * (command.velocity - feedback.velocity))

    def handover(self, effort: float, pwm: float, velocity: float, motor: MotorState) -> tuple[float, float]:
        """Return offset of position [rad] and velocity setpoint [rad/s] that go on with a torque."""
        return (effort / self.stiffness if self.stiffness else 0.0), velocity

    @property
    def dither(self) -> float:
        """No move of the position setpoint: every torque is compared with the measured one."""
        return 0.0

    def bounded(self, command: Command, motor: MotorState) -> Command:
        """Return the effort setpoint within the effort limit; all other setpoints are dropped."""
        limit = self.effort_limit
        effort = command.effort if math.isnan(command.effort) else min(limit, max(-limit, command.effort))
        return replace(Command(), effort=effort)

    def largest_effort(self, speed: float) -> float:
        """Return the effort limit, which the current loop holds at any speed [N m]."""
        return self.effort_limit

    def limited_gains(self, voltage: float) -> GainSet:
        """Return the gains unchanged: the current loop has none that can be set."""
        return self.gains


@dataclass(frozen=True)
class VoltageMapping(EffortMapping):
    """A plant in volts: its commands to the duty of the amplifier, under direct PWM and within the effort limit."""

    def command(self, effort: float, motor: MotorState) -> Command:
        """Return the duty of a voltage [V]."""
        return Command(pwm=effort / motor.voltage)

    def effort_of(self, command: Command, motor: MotorState, pwm_in_force: float) -> float:
        """Return the voltage of a duty [V]."""
        return 0.0 if math.isnan(command.pwm) else command.pwm * motor.voltage


class CurrentCheck(OutputCheck):
    """Checks that the measured effort lies within the range of recently commanded efforts."""

    def __init__(self, mapping: EffortMapping, pwm_limit: float = 1.0) -> None:
        super().__init__(mapping, pwm_limit)
        assert isinstance(mapping, CurrentMapping)
        self._before = deque([0.0], maxlen=1 + mapping.late)
        self._differs: deque[bool] = deque(maxlen=_RECORDS)

    def reset(self) -> None:
        """Forget earlier records after a change of strategy."""
        super().reset()
        self._before.clear()
        self._before.append(0.0)
        self._differs.clear()

    def check(self, feedback: Feedback, strategy: Strategy, candidates: Sequence[Command]) -> Fault | None:
        """Return the fault that a record shows, or None; ``candidates`` may be in force, the likeliest first."""
        efforts = [0.0 if math.isnan(each.effort) else each.effort for each in candidates]
        # The current loop lags, so earlier setpoints may still show.
        known = [*efforts, *self._before]
        self._before.append(efforts[0])
        room, unit = _SHARE * self.mapping.effort_limit, self.mapping.joint.effort_unit
        self._differs.append(not min(known) - room <= feedback.effort <= max(known) + room)
        if sum(self._differs) < _WRONG:
            return None
        return Fault(
            "output_disagreement",
            f"measured effort is {feedback.effort:.3f} {unit}, commanded is {efforts[0]:.3f} {unit}; expected them "
            f"within {room:.3g} {unit}: is the drive stuck?",
        )
