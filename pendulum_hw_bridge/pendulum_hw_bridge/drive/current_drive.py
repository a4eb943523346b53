"""Drives with a current loop: a torque is commanded as such, and what they report must follow it."""

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

__all__ = ["CurrentCheck", "CurrentMapping"]

_RECORDS = 4
_WRONG = 3
"""Of so many records, so many with another torque than commanded are a fault: one packet may get lost."""
_SHARE = 0.1
"""Share of the effort limit by which the measured effort may differ from those commanded [-]."""


@dataclass(frozen=True)
class CurrentMapping(EffortMapping):
    """Torque to setpoint where the drive makes the torque: the same number, within the effort limit.

    Args:
        late: Records for which a torque may still be that of an older setpoint, since the drive has a delay [-].
    """

    late: int = 0

    def bounded(self, command: Command, motor: MotorState) -> Command:
        """Return setpoints within the effort limit; there are no others than those of effort.

        Args:
            command: The setpoints.
            motor: Supply and motor speed, which decide nothing here.
        """
        limit = self.effort_limit
        effort = command.effort if math.isnan(command.effort) else min(limit, max(-limit, command.effort))
        return replace(Command(), effort=effort)

    def largest_effort(self, speed: float) -> float:
        """Return the largest torque at a speed [rad/s], which the current loop keeps at the limit [N m]."""
        return self.effort_limit

    def limited_gains(self, voltage: float) -> GainSet:
        """Return the gains as they are: the current loop has none of its own, whatever the voltage [V]."""
        return self.gains


class CurrentCheck(OutputCheck):
    """Checks that the measured effort is one of those commanded lately, or between them.

    Args:
        mapping: Torque to setpoint, with the effort limit.
        pwm_limit: Largest duty [-].
    """

    def __init__(self, mapping: EffortMapping, pwm_limit: float = 1.0) -> None:
        super().__init__(mapping, pwm_limit)
        assert isinstance(mapping, CurrentMapping)
        self._before = deque([0.0], maxlen=1 + mapping.late)
        self._differs: deque[bool] = deque(maxlen=_RECORDS)

    def reset(self) -> None:
        """Forget earlier records: another strategy begins, or none."""
        super().reset()
        self._before.clear()
        self._before.append(0.0)
        self._differs.clear()

    def check(self, feedback: Feedback, strategy: Strategy, candidates: Sequence[Command]) -> Fault | None:
        """Return the fault that a record shows, or None.

        Args:
            feedback: The record.
            strategy: Strategy that was set, not off.
            candidates: Setpoints that may be in force, the likeliest first.
        """
        efforts = [0.0 if math.isnan(each.effort) else each.effort for each in candidates]
        # The loop lags: it may still be on its way from what was commanded before.
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
