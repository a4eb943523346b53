"""Nominal periods of a plant of one joint, run by compiled code for some milliseconds at a time.

The loop ends before anything else (a refused command, silence, a transition, a service), which Python handles; the
state of supervisor, gates and plant is the same to the last bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable
from typing import Any, NamedTuple, Protocol

import numpy as np

from pendulum_msgs_py.contract.cdr import JointStateFields, MessageTemplate, encode_clock, template_of
from pendulum_msgs_py.contract.ordinary import lend, take_back
from pendulum_msgs_py.contract.rules import NEVER
from pendulum_msgs_py.contract.supervisor import Input
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample
from pendulum_msgs_py.loops.machine_code import load_loop
from pendulum_msgs_py.loops.plant_record import (
    DISTURBANCE,
    EFFORT,
    ENDED,
    MESSAGE_WAITS,
    OWN_STAMPS,
    PUSH,
    plant_record,
)
from pendulum_msgs_py.loops.records import expect_template, set_template, structure_of
from pendulum_msgs_py.ros.convert import fields_from_bytes
from pendulum_msgs_py.ros.direct import DirectTopics, rcl_symbols
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.qos import COMMAND_INPUT
from pendulum_msgs_py.ros.turns import LONGEST_SLICE

__all__ = ["CompiledPeriods", "CompiledPlant", "Slice"]

_INPUTS = {Input.EFFORT_COMMAND: EFFORT, Input.DISTURBANCE: DISTURBANCE, Input.PUSH: PUSH}
_KINDS = {index: kind for kind, index in _INPUTS.items()}
_NO_END = 2**62


class Slice(NamedTuple):
    """Result of a slice.

    Attributes:
        now_ns: The plant's time, that of its newest state [ns].
        periods: Number of periods.
        answered: In lockstep: inputs that have answered the newest state.
        message: A taken message that is left to Python: its input, its bytes, its arrival [ns].
        ended: Its time was over or a call is pending.
    """

    now_ns: int
    periods: int
    answered: Collection[Input]
    message: tuple[Input, bytes, int] | None = None
    ended: bool = False


class CompiledPlant(Protocol):
    """A plant that compiled code can step."""

    @property
    def builder(self) -> str:
        """Builder of its loop, ``module:function``."""

    @property
    def choice(self) -> tuple[str, ...]:
        """Arguments of the builder."""

    @property
    def layout(self) -> np.dtype[Any]:
        """Layout of its part of the record."""

    def describe(self, record: Any) -> None:
        """Write the constants into its part of the record."""

    def lend(self, record: Any) -> None:
        """Write the state."""

    def take_back(self, record: Any) -> None:
        """Read the state back."""


class CompiledPeriods:
    """The loop of one plant; raises a NoMachineCodeError if unavailable.

    Args:
        interface: The plant on the graph, with polled inputs.
        plant: The plant.
        period_ns: Period [ns].
        clock: Wall time in real time; None in lockstep.
        clock_publisher: Publishes ``/clock``, or None.
        done: Called after periods with the stamp of the newest state [ns].
    """

    def __init__(
        self,
        interface: PlantInterface,
        plant: CompiledPlant,
        period_ns: int,
        *,
        clock: SteadyWallClock | None,
        clock_publisher: Any = None,
        done: Callable[[int], None],
    ) -> None:
        self._interface = interface
        self._plant = plant
        self._clock = clock
        self._done = done
        self.periods = 0
        self._loop = load_loop(plant.builder, *plant.choice, symbols=rcl_symbols())
        self._memory = np.zeros(1, dtype=plant_record(plant.layout))
        # numpy's view for what is written once, a faster one for each slice.
        self._entries = record = self._memory[0]
        self._record: Any = structure_of(self._memory.dtype).from_buffer(self._memory.data)
        self._topics = DirectTopics()
        self._templates: dict[Input, MessageTemplate | None] = {}
        for kind, index in _INPUTS.items():
            self._topics.add_input(record["inputs"][index], interface.inputs[kind], COMMAND_INPUT.depth)
        coordinates = interface.supervisor.coordinates
        one = (0.0,)
        state = JointStateFields(0, "", coordinates.names, one, one, one)
        effort = JointStateFields(0, "", coordinates.driven_names, (), (), one)
        for name, publisher, template in (
            ("states", interface.state_publisher, template_of(state)),
            ("applied", interface.applied_publisher, template_of(effort)),
            ("clock", clock_publisher, MessageTemplate(encode_clock(0), b"", ())),
        ):  # fmt: skip
            if publisher is not None:
                self._topics.add_output(record[name], publisher)
                set_template(record[name], template)
        record["has_clock"] = clock_publisher is not None
        record["waiting_at"] = interface.supervisor.waiting_at
        record["lockstep"] = clock is None
        record["period_ns"] = period_ns
        record["counter"] = -1 if clock is not None else interface.watch_inputs().descriptor
        record["own_stamp_ns"] = NEVER
        plant.describe(self._record.plant)

    def run(
        self,
        now_ns: int,
        *,
        longest: float = LONGEST_SLICE,
        expected: Collection[Input] = (),
        answered: Collection[Input] = (),
        last_ns: int | None = None,
    ) -> Slice:
        """Run nominal periods.

        Args:
            now_ns: The plant's time, that of its newest state [ns].
            longest: Longest duration [s].
            expected: In lockstep: inputs that have to answer a state.
            answered: In lockstep: those that have answered the newest.
            last_ns: In lockstep: the time at which the plant stops [ns].
        """
        interface, record, supervisor = self._interface, self._record, self._interface.supervisor
        sample = interface.sample
        if sample is None:
            return Slice(now_ns, 0, answered)
        self._expect_messages()
        with supervisor.alone():
            if not lend(supervisor, record.rules):
                return Slice(now_ns, 0, answered)
            self._plant.lend(record.plant)
            record.now_ns, record.expected, record.answered = now_ns, _bits(expected), _bits(answered)
            record.last_ns = _NO_END if last_ns is None else last_ns
            record.sample_ns, (record.position,), (record.velocity,), (record.effort,) = sample
            record.wall_ahead_ns = 0 if self._clock is None else self._clock.ahead_ns
            record.published_ns = interface.published_ns
            record.end_ns = time.monotonic_ns() + round(longest * NANOSECONDS)
            record.calls[:] = interface.calls
            record.periods = record.latencies = 0
            self._lend_stamps()
            with self._topics.held():
                why = self._loop(self._memory)
            take_back(supervisor, record.rules)
            if record.periods:
                self._take_back(record.periods)
        message = None
        if why >= MESSAGE_WAITS:
            kind = _KINDS[why - MESSAGE_WAITS]
            source = self._entries["inputs"][_INPUTS[kind]]
            message = kind, DirectTopics.message(source), int(source["info"][1])
        has_answered = record.answered
        newest = [kind for kind, index in _INPUTS.items() if has_answered >> index & 1]
        return Slice(record.now_ns, record.periods, newest, message, why == ENDED)

    def _expect_messages(self) -> None:
        for kind, data in self._interface.pop_accepted().items():
            fields = fields_from_bytes(data)
            template = None if fields is None else template_of(fields, len(data))
            if template != self._templates.get(kind):
                self._templates[kind] = template
                expect_template(self._entries["inputs"][_INPUTS[kind]], template)

    def _lend_stamps(self) -> None:
        stamps, record = self._interface.commander_watch.own_stamps, self._record
        if stamps and record.own_stamp_ns[record.own_newest] != stamps[0]:
            # Python has published since.
            record.own_stamp_ns[: len(stamps)] = tuple(reversed(stamps))
            record.own_newest = len(stamps) - 1

    def _take_back(self, periods: int) -> None:
        record, interface = self._record, self._interface
        self.periods += periods
        self._plant.take_back(record.plant)
        stamp_ns, period_ns = record.now_ns, record.period_ns
        interface.sample = JointSample.of_one(stamp_ns, record.position, record.velocity, record.effort)
        interface.published_ns = record.published_ns
        interface.commander_watch.note_states(stamp_ns, period_ns, min(periods, OWN_STAMPS))
        statistics = interface.statistics
        if statistics is not None and self._clock is not None:
            late_ns = record.late_ns[:periods]
            statistics.punctual_cycles(late_ns, stamp_ns - (periods - 1) * period_ns + late_ns[0])
            statistics.latency.extend(record.latency_ns[: record.latencies])
        self._done(stamp_ns)


def _bits(inputs: Iterable[Input]) -> int:
    return sum(1 << _INPUTS[kind] for kind in inputs)
