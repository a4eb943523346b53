"""A plant's compiled loop by itself, between an rcl that the test plays: when it ends, and what it has done by then."""

from __future__ import annotations

import ctypes
import platform
import struct
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pendulum_msgs_py.contract.cdr import JointStateFields, decode_joint_state, encode_joints, template_of
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.rules import NEVER
from pendulum_msgs_py.loops.machine_code import Loop, load_loop
from pendulum_msgs_py.loops.plant_record import (
    DISTURBANCE,
    EFFORT,
    ENDED,
    INPUTS,
    MESSAGE_WAITS,
    PUSH,
    UNUSUAL,
    plant_record,
)
from pendulum_msgs_py.loops.records import MESSAGE, expect_template, set_template, structure_of
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.simulator.loop_plant import BUILDER, LAYOUT, LoopPlant
from pendulum_sim.stepping.plant import RigidPlant

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="loops are compiled on Linux for x86_64"
)

_ME = "/peer"
_PERIOD_NS = 100_000_000
"""Long, for a busy machine."""
_STATES, _APPLIED = 101, 102
_NONE_LEFT, _OK, _ERROR = 401, 0, 1
_ADDRESS = ctypes.c_void_p


class Rcl:
    """What the loop calls: messages that wait, those that went out, and what happens meanwhile."""

    def __init__(self) -> None:
        self.waiting: list[deque[bytes]] = [deque() for _ in range(INPUTS)]
        self.published: list[tuple[int, bytes]] = []
        self.take_code = self.publish_code = _OK
        self.on_publish: Callable[[], None] = lambda: None
        self._kept = b""

    def take(self, subscription: int, message: int, _info: int, _allocation: int) -> int:
        waiting = self.waiting[subscription - 1]
        if self.take_code:
            return self.take_code
        if not waiting:
            return _NONE_LEFT
        self._kept = waiting.popleft()
        place = structure_of(MESSAGE).from_address(message)
        place.buffer, place.length = ctypes.cast(ctypes.c_char_p(self._kept), _ADDRESS).value, len(self._kept)
        return _OK

    def publish(self, publisher: int, message: int, _allocation: int) -> int:
        place = structure_of(MESSAGE).from_address(message)
        self.published.append((publisher, ctypes.string_at(place.buffer, place.length)))
        self.on_publish()
        return self.publish_code

    def count(self, _publisher: int, found: int) -> int:
        ctypes.c_uint64.from_address(found).value = 1
        return _OK


_present = [Rcl()]
_take = ctypes.CFUNCTYPE(ctypes.c_int, *[_ADDRESS] * 4)(
    lambda *given: _present[0].take(*given)  # noqa: PLW0108  (that of the test that runs)
)
_publish = ctypes.CFUNCTYPE(ctypes.c_int, *[_ADDRESS] * 3)(
    lambda *given: _present[0].publish(*given)  # noqa: PLW0108  (that of the test that runs)
)
_count = ctypes.CFUNCTYPE(ctypes.c_int, *[_ADDRESS] * 2)(
    lambda *given: _present[0].count(*given)  # noqa: PLW0108  (that of the test that runs)
)


@pytest.fixture(scope="module")
def loop() -> Loop:
    """Return the loop of the plant, compiled; it calls whatever rcl a test has."""
    symbols = {"pendulum_rcl_take": _take, "pendulum_rcl_publish": _publish, "pendulum_rcl_count": _count}
    addresses = {name: ctypes.cast(function, _ADDRESS).value or 0 for name, function in symbols.items()}
    return load_loop(BUILDER, "etd4", symbols=addresses)


class Plant:
    """A plant whose next deadline is now, under a command of 0.5 N m that it took before."""

    def __init__(self, loop: Loop) -> None:
        self.rcl = _present[0] = Rcl()
        self._loop = loop
        self._memory = np.zeros(1, dtype=plant_record(LAYOUT))
        self._entries = entries = self._memory[0]
        self.record: Any = structure_of(self._memory.dtype).from_buffer(self._memory.data)
        command = template_of(JointStateFields(0, _ME, (JOINT,), (), (), (0.0,)))
        for index in range(INPUTS):
            entries["inputs"][index]["subscription"], entries["inputs"][index]["most"] = index + 1, 5
            expect_template(entries["inputs"][index], command)
        one = (0.0,)
        for name, publisher, fields in (
            ("states", _STATES, JointStateFields(0, "", (JOINT,), one, one, one)),
            ("applied", _APPLIED, JointStateFields(0, "", (JOINT,), (), (), one)),
        ):
            entries[name]["publisher"] = publisher
            set_template(entries[name], template_of(fields))
        plant = LoopPlant(RigidPlant(load_plant("thesis"), 0.002))
        plant.describe(self.record.plant)
        plant.lend(self.record.plant)
        self.waiting = ctypes.c_int64(0)
        record = self.record
        record.waiting_at = ctypes.addressof(self.waiting)
        record.counter, record.calls[:] = -1, (-1, -1)
        record.period_ns, record.now_ns = _PERIOD_NS, time.monotonic_ns() - _PERIOD_NS
        record.sample_ns = record.now_ns
        record.own_stamp_ns[:] = (NEVER,) * len(record.own_stamp_ns)
        record.own_stamp_ns[0] = record.now_ns
        rules = record.rules
        for gate in (rules.command, rules.disturbance):
            gate.timeout_ns, gate.newest_ns = 500_000_000, NEVER
        rules.command.newest_ns, rules.command.heard_ns, rules.command.effort = record.now_ns - 1000, record.now_ns, 0.5
        rules.limit, rules.slew, rules.fastest, rules.feedback_timeout = 5.0, np.inf, np.inf, 1.0
        rules.lowest, rules.highest = -np.inf, np.inf
        rules.decided_ns = rules.commanded_ns = record.now_ns

    def run(self, periods: float = 3.5, late_ns: int = 0) -> int:
        """Run for so many periods, unless it ends by itself; return why it ended.

        The plant's clock begins here, at its deadline or after it: how long the test took to come here is no lateness.
        """
        now_ns = time.monotonic_ns()
        self.record.wall_ahead_ns = self.record.now_ns + _PERIOD_NS + late_ns - now_ns
        self.record.end_ns = now_ns + round(periods * _PERIOD_NS)
        return self._loop(self._memory)

    def answer(self, effort: float = 1.0, stamp_ns: int | None = None) -> bytes:
        return encode_joints(self.record.now_ns if stamp_ns is None else stamp_ns, _ME, (JOINT,), (), (), (effort,))

    def efforts(self) -> list[float]:
        """Return the efforts that were published as applied."""
        decoded = [decode_joint_state(data) for publisher, data in self.rcl.published if publisher == _APPLIED]
        return [fields.effort[0] for fields in decoded if fields is not None]


@pytest.fixture
def plant(loop: Loop) -> Plant:
    """Return a plant that is ready for ordinary periods."""
    return Plant(loop)


def test_ordinary_periods_run_until_their_time_is_over(plant: Plant) -> None:
    plant.rcl.waiting[EFFORT].append(plant.answer(1.0))
    assert plant.run() == ENDED
    assert plant.record.periods >= 2
    assert plant.efforts() == [1.0] * plant.record.periods
    assert [publisher for publisher, _ in plant.rcl.published[:2]] == [_STATES, _APPLIED]


def test_a_late_period_is_pythons(plant: Plant) -> None:
    assert plant.run(late_ns=_PERIOD_NS) == UNUSUAL
    assert not plant.rcl.published


def test_the_period_after_a_stop_of_the_process_is_pythons(plant: Plant) -> None:
    plant.rcl.on_publish = lambda: time.sleep(2.5e-9 * _PERIOD_NS)
    assert plant.run(50.0) == UNUSUAL
    assert plant.record.periods == 1


def test_nothing_is_decided_while_somebody_wants_the_supervisor(plant: Plant) -> None:
    def press() -> None:
        plant.waiting.value = 1

    plant.rcl.on_publish = press
    assert plant.run() == UNUSUAL
    assert plant.record.periods == 1
    assert plant.run() == UNUSUAL
    assert plant.record.periods == 1


@pytest.mark.parametrize("kind", [EFFORT, DISTURBANCE, PUSH])
def test_what_rcl_cannot_take_is_pythons(plant: Plant, kind: int) -> None:
    plant.rcl.take_code = _ERROR
    assert plant.run() == MESSAGE_WAITS + EFFORT
    assert not plant.rcl.published
    plant.rcl.take_code = _OK
    plant.rcl.waiting[kind].append(b"\x00\x01\x00\x00")
    assert plant.run() == MESSAGE_WAITS + kind
    assert plant.record.periods == plant.record.rules.decisions == 0


@pytest.mark.parametrize("stamp", [-1, -_PERIOD_NS, 1, 1_000])
def test_a_command_that_answers_no_state_of_ours_is_pythons(plant: Plant, stamp: int) -> None:
    plant.rcl.waiting[EFFORT].append(plant.answer(9.0, plant.record.now_ns + stamp))
    assert plant.run() == MESSAGE_WAITS + EFFORT
    assert plant.record.rules.command.effort == 0.5


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.replace(_ME.encode(), b"/peeR"),
        lambda data: data.replace(JOINT.encode(), JOINT.upper().encode()),
        lambda data: data + bytes(4),
        lambda data: data[:-8],
        # The same time, written as nobody may.
        lambda data: data[:4] + struct.pack("<II", *_carried(*struct.unpack_from("<II", data, 4))) + data[12:],
    ],
    ids=["another sender", "another joint", "longer", "shorter", "too many nanoseconds"],
)
def test_what_is_not_as_expected_is_pythons(plant: Plant, change: Callable[[bytes], bytes]) -> None:
    plant.rcl.waiting[EFFORT].append(change(plant.answer(2.0)))
    assert plant.run() == MESSAGE_WAITS + EFFORT
    assert plant.record.rules.command.effort == 0.5


def _carried(seconds: int, nanoseconds: int) -> tuple[int, int]:
    return seconds - 1, nanoseconds + 1_000_000_000


def test_a_push_is_pythons_whatever_was_expected(plant: Plant) -> None:
    plant.rcl.waiting[PUSH].append(plant.answer(1.0))
    assert plant.run() == MESSAGE_WAITS + PUSH
    assert not plant.rcl.published


def test_a_state_that_could_not_be_published_ends_the_loop(plant: Plant) -> None:
    plant.rcl.publish_code = _ERROR
    assert plant.run() == UNUSUAL
    # It was stepped, and Python goes on from there: to the error that its own attempt meets.
    assert plant.record.periods == 1
    assert plant.record.now_ns == plant.record.sample_ns == plant.record.rules.decided_ns


def test_silence_is_pythons(plant: Plant) -> None:
    plant.record.rules.command.timeout_ns = 2 * _PERIOD_NS
    assert plant.run(20.0) == UNUSUAL
    assert plant.record.periods <= 2
    assert set(plant.efforts()) == {0.5}
