"""Conflicts on the graph: several commanders of one name, and a second plant of the same names."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque

from rclpy.node import Node

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.supervisor import Input, PlantSupervisor
from pendulum_msgs_py.contract.values import JointCommand

__all__ = ["CHECK_PERIOD_NS", "CommanderWatch"]

CHECK_PERIOD_NS = 50_000_000
"""Shortest time between two checks of the graph after suspect messages [ns]."""
_HOLD_NS = 1_000_000_000
"""Time for which a contradiction or a foreign state counts [ns]."""
_OWN_STATES = 128
"""Own stamps among which a command's stamp is searched."""
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Discovery's name of a node whose name has not arrived yet."""


class CommanderWatch:
    """Reports conflicts that no single message shows to a plant's supervisor, which then applies no torque."""

    def __init__(self, node: Node, supervisor: PlantSupervisor) -> None:
        self._node = node
        self._supervisor = supervisor
        self._topics = supervisor.coordinates.topics
        self._commands = node.resolve_topic_name(self._topics.command)
        self.in_other_unit = ""
        """Topics with commands in another unit than the plant's, which have no effect; empty for none."""
        self._states = node.resolve_topic_name(names.JOINT_STATES)
        self._looking = threading.Lock()
        self._checked_ns = 0
        self._contradicted_ns: int | None = None
        self.own_stamps: deque[int] = deque(maxlen=_OWN_STATES)
        """Stamps of published states, the newest first [ns]."""
        self._foreign_ns: int | None = None

    def note_state(self, stamp_ns: int) -> None:
        """Record the stamp of a published state [ns]."""
        self.own_stamps.appendleft(stamp_ns)

    def note_states(self, newest_ns: int, period_ns: int, count: int) -> None:
        """Record the stamps of states published in consecutive periods [ns]."""
        self.own_stamps.extendleft(range(newest_ns - (count - 1) * period_ns, newest_ns + 1, period_ns))

    def suspect_twins(self, command: JointCommand, now_ns: int) -> None:
        """Check the graph if a second command for one state differs: two commanders may share a name.

        An equal command is a repetition, as in lockstep after a lost message.
        """
        newest = self._supervisor.gates[Input.EFFORT_COMMAND].fresh(now_ns)
        if newest is None or newest.effort == command.effort:
            return
        self._contradicted_ns = time.monotonic_ns()
        self._check_soon(self._contradicted_ns)

    def suspect_second_plant(self, command: JointCommand) -> None:
        """Check the graph if a command is for a foreign state: a second plant may share our names.

        A controller that stamps with the time of day is no conflict, while no other node publishes states.
        """
        if command.stamp_ns not in self.own_stamps:
            self._foreign_ns = time.monotonic_ns()
            self._check_soon(self._foreign_ns)

    def check(self) -> None:
        """Check the graph and report a conflict, or none, to the supervisor; from any thread."""
        # Serialised: an earlier check must not clear the conflict of a later one.
        with self._looking:
            self._checked_ns = now = time.monotonic_ns()
            conflict = self._two_commanders(now) or self._two_plants(now)
            if conflict and conflict != self._supervisor.commander_conflict:
                self._node.get_logger().error(conflict)
            self._supervisor.set_commander_conflict(conflict)

    def look_for_other_unit(self) -> None:
        """Log publishers of commands in newton metres to a plant in volts, or the reverse."""
        coordinates, text = self._supervisor.coordinates, ""
        others, carried = (names.EFFORT_TOPICS, "efforts") if coordinates.volts else (names.VOLTAGE_TOPICS, "volts")
        found = [name for name in others[:2] if self._node.count_publishers(self._node.resolve_topic_name(name))]
        if found:
            text = (
                f"{' and '.join(found)} without effect, which carries {carried}: this plant is driven by "
                f"{self._topics.command} in {coordinates.drive_unit}"
            )
        if text and text != self.in_other_unit:
            self._node.get_logger().error(text)
        self.in_other_unit = text

    def _check_soon(self, now: int) -> None:
        if now - self._checked_ns >= CHECK_PERIOD_NS:
            self.check()

    def _two_commanders(self, now: int) -> str:
        topic = self._commands
        # Names take ten times as long to query as their number.
        if self._node.count_publishers(topic) < 2:
            return ""
        found = Counter(
            names.full_name(info.node_namespace, info.node_name)
            for info in self._node.get_publishers_info_by_topic(topic)
        )
        twins = [name for name, count in found.items() if count > 1 and not name.endswith(_UNKNOWN_NODE)]
        if twins:
            return f"{found[twins[0]]} commanders named {twins[0]} on {topic}; expected one: zero torque"
        gate = self._supervisor.gates[Input.EFFORT_COMMAND]
        if found.total() < 2 or gate.newest_stamp_ns is None:
            return ""
        if gate.commander == "":
            return f"{found.total()} unnamed commanders on {topic}; expected one, or a frame_id: zero torque"
        if self._contradicted_ns is not None and now - self._contradicted_ns < _HOLD_NS:
            return (
                f"{found.total()} commanders on {topic} give two answers to one state as {gate.commander!r}; "
                "expected a frame_id of its own for each: zero torque"
            )
        return ""

    def _two_plants(self, now: int) -> str:
        if self._foreign_ns is None or now - self._foreign_ns >= _HOLD_NS:
            return ""
        plants = self._node.count_publishers(self._states)
        if plants < 2:
            return ""
        return f"{plants} plants on {self._states}, and commands answer another's states; expected one: zero torque"
