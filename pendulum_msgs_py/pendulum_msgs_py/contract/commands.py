"""Command gates: one per input of a plant, with the same rules on simulator and hardware.

A gate refuses and counts commands that are not finite, for other joints, stale, from the future, duplicate, out of
order or from a second commander. The plant acts on the newest accepted command.
"""

from __future__ import annotations

import math
from collections import Counter
from enum import Enum

from pendulum_msgs_py.contract import rules
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.rules import ACCEPTED, FUTURE_TOLERANCE_NS, NEVER, has_expired, is_ahead, judge_stamp
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, written

__all__ = ["CommandGate", "Refusal"]


class Refusal(str, Enum):
    """Why a command was refused; the value is the key in diagnostics.

    ``not_one_joint``: not one value for each joint of the input. ``other_joint``: other names, or another order.
    """

    NOT_ONE_JOINT = "not_one_joint"
    OTHER_JOINT = "other_joint"
    NOT_FINITE = "not_finite"
    TOO_OLD = "too_old"
    FROM_FUTURE = "from_future"
    OUT_OF_ORDER = "out_of_order"
    DUPLICATE = "duplicate"
    SECOND_COMMANDER = "second_commander"


_REFUSALS = {
    rules.TOO_OLD: Refusal.TOO_OLD,
    rules.FROM_FUTURE: Refusal.FROM_FUTURE,
    rules.SECOND_COMMANDER: Refusal.SECOND_COMMANDER,
    rules.DUPLICATE: Refusal.DUPLICATE,
    rules.OUT_OF_ORDER: Refusal.OUT_OF_ORDER,
}


class CommandGate:
    """Checks the commands of one input and stores the newest accepted one.

    Args:
        timeout: Age at which a command expires [s], > 0.
        joints: Joints that commands must name, in this order; no names mean the only joint.
        partial: Whether a command may name some of the joints; the others get zero.
        unit: Unit of the efforts, for messages.

    Attributes:
        refused: Number of refusals by reason.
        problems: For each reason the newest refused field, its value and the expectation.
    """

    def __init__(
        self, timeout: float, *, joints: tuple[str, ...] = (JOINT,), partial: bool = False, unit: str = "N m"
    ) -> None:
        self.timeout_ns = round(timeout * NANOSECONDS)
        self.joints = joints
        self.partial = partial and len(joints) > 1
        self.unit = unit
        self.refused: Counter[Refusal] = Counter()
        self.problems: dict[Refusal, str] = {}
        self.accepted = 0
        self.refused_commander = ""
        self._newest: JointCommand | None = None
        self._heard_ns = 0
        self._holder = ""
        self._expired = False

    def refuse_malformed(self, problem: str = "") -> Refusal:
        """Count a message that is no command for joints."""
        self.refused[Refusal.NOT_ONE_JOINT] += 1
        self.problems[Refusal.NOT_ONE_JOINT] = problem
        return Refusal.NOT_ONE_JOINT

    def offer(self, command: JointCommand, now_ns: int) -> Refusal | None:
        """Accept a command at a time of the plant's clock [ns], or return why it is refused."""
        refusal = self._judge(command, now_ns)
        if refusal is None:
            last = self._newest is not None and rules.is_last(command.stamp_ns, self._newest.stamp_ns)
            self._expired = last and not any(command.effort)
            self._newest = command if len(command.effort) == len(self.joints) else self._filled(command)
            self._heard_ns = now_ns
            self._holder = command.source
            self.accepted += 1
        else:
            self.refused[refusal] += 1
            self.problems[refusal] = self._problem(refusal, command, now_ns)
            if refusal is Refusal.SECOND_COMMANDER:
                self.refused_commander = command.source
        return refusal

    def fresh(self, now_ns: int) -> JointCommand | None:
        """Return the newest accepted command unless it has expired."""
        newest = self._newest
        if newest is None:
            return None
        # An expired command stays expired when the clock steps back: torque does not return without a command.
        self._expired = self._expired or has_expired(newest.stamp_ns, self._heard_ns, now_ns, self.timeout_ns)
        return None if self._expired or is_ahead(newest.stamp_ns, now_ns) else newest

    @property
    def newest(self) -> JointCommand | None:
        """The newest accepted command, expired or not; None before the first."""
        return self._newest

    @property
    def newest_stamp_ns(self) -> int | None:
        """Its stamp [ns], or None."""
        return None if self._newest is None else self._newest.stamp_ns

    @property
    def commander(self) -> str:
        """Source of the newest accepted command."""
        return self._holder

    def reset(self) -> None:
        """Forget command and commander; counters stay."""
        self._newest = None
        self._holder = ""

    def _judge(self, command: JointCommand, now_ns: int) -> Refusal | None:
        joints = command.joints
        if (joints != self.joints or not joints) and (refusal := self._judge_names(joints)) is not None:
            return refusal
        if len(command.effort) != (len(joints) or 1):
            return Refusal.NOT_ONE_JOINT
        for effort in command.effort:
            if not math.isfinite(effort):
                return Refusal.NOT_FINITE
        newest_ns = NEVER if self._newest is None else self._newest.stamp_ns
        other = command.source != self._holder
        verdict = judge_stamp(command.stamp_ns, now_ns, self.timeout_ns, newest_ns, self._heard_ns, other)
        return None if verdict == ACCEPTED else _REFUSALS[verdict]

    def _judge_names(self, joints: tuple[str, ...]) -> Refusal | None:
        if not joints and len(self.joints) == 1:
            return None
        if not self.partial:
            return Refusal.OTHER_JOINT if joints and len(joints) == len(self.joints) else Refusal.NOT_ONE_JOINT
        if not joints:
            return Refusal.NOT_ONE_JOINT
        return None if joints == tuple(name for name in self.joints if name in joints) else Refusal.OTHER_JOINT

    def _filled(self, command: JointCommand) -> JointCommand:
        given = dict(zip(command.joints, command.effort, strict=True))
        effort = tuple(given.get(name, 0.0) for name in self.joints)
        return command._replace(effort=effort, joints=self.joints)

    def _expected_names(self) -> str:
        if len(self.joints) == 1:
            return f"expected [{self.joints[0]!r}] or none"
        if not self.joints:
            return "expected no command: no joint has a motor"
        return f"expected {list(self.joints)}" + (", or some of them in this order" if self.partial else "")

    def _names_problem(self, command: JointCommand) -> str:
        if self._judge_names(command.joints) is None or command.joints == self.joints:
            return f"effort has {len(command.effort)} values; expected {len(command.joints) or 1}"
        return f"name is {list(command.joints)}; {self._expected_names()}"

    def _problem(self, refusal: Refusal, command: JointCommand, now_ns: int) -> str:
        age = (now_ns - command.stamp_ns) / NANOSECONDS
        newest_ns = self.newest_stamp_ns
        since = 0.0 if newest_ns is None else (command.stamp_ns - newest_ns) / NANOSECONDS
        return {
            Refusal.NOT_ONE_JOINT: self._names_problem(command),
            Refusal.OTHER_JOINT: self._names_problem(command),
            Refusal.NOT_FINITE: f"effort is {written(command.effort)} {self.unit}; expected a finite number"
            if len(command.effort) == 1
            else f"effort is {written(command.effort)}; expected finite numbers",
            Refusal.TOO_OLD: f"header.stamp is {age:.6g} s before the plant's time; expected at most "
            f"{self.timeout_ns / NANOSECONDS:g} s",
            Refusal.FROM_FUTURE: f"header.stamp is {-age:.6g} s after the plant's time; expected at most "
            f"{FUTURE_TOLERANCE_NS / NANOSECONDS:g} s",
            Refusal.OUT_OF_ORDER: f"header.stamp is {-since:.6g} s before that of the command before",
            Refusal.DUPLICATE: "header.stamp is that of the command before; expected one answer to a state",
            Refusal.SECOND_COMMANDER: f"header.frame_id is {command.source!r}; {self._holder!r} commands",
        }[refusal]
