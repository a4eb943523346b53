"""What compiled loops decide, against the supervisor: the same effort and the same state, or nothing at all."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.ordinary import lend, take_back
from pendulum_msgs_py.contract.rules import NEVER
from pendulum_msgs_py.contract.supervisor import DriveKind, Input, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.loops.plant_record import plant_record
from pendulum_msgs_py.loops.plant_rules import accept, decide

_LAYOUT = plant_record(np.dtype([("nothing", "f8")]))
_NOW = 100 * NANOSECONDS
_MS = 1_000_000
_LIMITS = PlantLimits(
    (2.0,), feedback_timeout=0.02, velocity=5.0, position_min=(-10.0,), position_max=(10.0,), slew=400.0
)


def _record() -> Any:
    return np.zeros(1, dtype=_LAYOUT).view(np.recarray)[0]


def _armed(limits: PlantLimits = _LIMITS, *, disturbed: bool = True) -> PlantSupervisor:
    """Return a supervisor that has been commanded and disturbed for a period."""
    supervisor = PlantSupervisor(limits)
    sample = JointSample.of_one(_NOW, 1.0, 0.0)
    assert supervisor.arm(_NOW, sample) == ""
    assert supervisor.offer(Input.EFFORT_COMMAND, JointCommand(_NOW, (0.5,), "/me", (JOINT,)), _NOW) is None
    if disturbed:
        assert supervisor.offer(Input.DISTURBANCE, JointCommand(_NOW, (0.25,), "/noise", (JOINT,)), _NOW) is None
    supervisor.decide(_NOW, sample)
    return supervisor


def _state(supervisor: PlantSupervisor) -> dict[str, Any]:
    """Return all that a decision may change; where a trajectory began says nothing as long as there is none."""
    left_out = {"gates", "preflight", "_trajectory_start_ns"}
    kept = {name: value for name, value in vars(supervisor).items() if name not in left_out}
    for kind, gate in supervisor.gates.items():
        kept |= {f"{kind.value}{name}": copy.copy(value) for name, value in vars(gate).items()}
    return {name: value for name, value in kept.items() if not hasattr(value, "offer")}


def _lent(supervisor: PlantSupervisor, sample: JointSample) -> Any:
    record = _record()
    assert lend(supervisor, record.rules)
    record.sample_ns, (record.position,), (record.velocity,), (record.effort,) = sample
    return record


_times = st.integers(-40 * _MS, 80 * _MS) | st.sampled_from(
    [0, 5 * _MS, 5 * _MS + 1, 50 * _MS, 50 * _MS + 1, 20 * _MS, -1, NANOSECONDS, NANOSECONDS + 1, 2 * NANOSECONDS]
)
_numbers = st.floats(-20.0, 20.0) | st.sampled_from([0.0, -0.0, 10.0, -10.0, 5.0, -5.0, math.nan, math.inf, 1e308])


@settings(max_examples=300, deadline=None)
@given(later=_times, behind=_times, position=_numbers, velocity=_numbers, torque=_numbers, disturbed=st.booleans())
@example(later=2 * _MS, behind=0, position=1.0, velocity=0.0, torque=0.0, disturbed=True)
@example(later=50 * _MS, behind=0, position=1.0, velocity=0.0, torque=0.0, disturbed=True)
@example(later=50 * _MS + 1, behind=0, position=1.0, velocity=0.0, torque=0.0, disturbed=True)
@example(later=-5 * _MS - 1, behind=0, position=1.0, velocity=0.0, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=20 * _MS, position=1.0, velocity=0.0, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=-20 * _MS, position=1.0, velocity=0.0, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=20 * _MS + 1, position=1.0, velocity=0.0, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=-20 * _MS - 1, position=1.0, velocity=0.0, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=0, position=1.0, velocity=5.1, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=0, position=10.1, velocity=0.0, torque=0.0, disturbed=False)
@example(later=2 * _MS, behind=0, position=1.0, velocity=0.0, torque=math.nan, disturbed=False)
@example(later=2 * _MS, behind=0, position=1.0, velocity=0.0, torque=math.inf, disturbed=False)
@example(later=2 * _MS, behind=0, position=1.0, velocity=math.nan, torque=0.0, disturbed=False)
def test_a_decision_is_the_supervisors_or_none(
    later: int, behind: int, position: float, velocity: float, torque: float, disturbed: bool
) -> None:
    ours, theirs = _armed(disturbed=disturbed), _armed(disturbed=disturbed)
    now = _NOW + later
    sample = JointSample.of_one(now - behind, position, velocity, torque)
    record = _lent(ours, sample)
    before = bytes(record)
    done = decide(record, now)
    drive = theirs.decide(now, sample)
    assert done == (drive.kind is DriveKind.EFFORT and not drive.starved)
    if not done:
        assert bytes(record) == before
        take_back(ours, record.rules)
        assert _state(ours) == _state(_armed(disturbed=disturbed))
        return
    take_back(ours, record.rules)
    assert (float(record.rules.last_effort),) == drive.effort
    theirs.report_applied(drive.effort)
    assert _state(ours) == _state(theirs)


def _ordinary(later: int, disturbed: bool) -> bool:
    supervisor = _armed(disturbed=disturbed)
    return decide(_lent(supervisor, JointSample.of_one(_NOW + later, 1.0, 0.0)), _NOW + later)


@pytest.mark.parametrize("disturbed", [True, False])
def test_an_ordinary_period_is_decided(disturbed: bool) -> None:
    """Else the test above would hold for a loop that decides nothing."""
    assert _ordinary(2 * _MS, disturbed)
    assert _ordinary(50 * _MS, disturbed)
    assert not _ordinary(50 * _MS + 1, disturbed)


@pytest.mark.parametrize("effort", [1.2, 9.0, -9.0])
@pytest.mark.parametrize("slew", [math.inf, 100.0])
def test_sums_limits_and_rises_are_the_supervisors(effort: float, slew: float) -> None:
    limits = PlantLimits((2.0,), slew=slew)
    ours, theirs = _armed(limits), _armed(limits)
    for k in range(1, 5):
        now = _NOW + 2 * k * _MS
        sample = JointSample.of_one(now, 1.0, 0.0)
        for supervisor in (ours, theirs):
            supervisor.offer(Input.EFFORT_COMMAND, JointCommand(now, (effort / k,), "/me", (JOINT,)), now)
        record = _lent(ours, sample)
        assert decide(record, now)
        take_back(ours, record.rules)
        drive = theirs.decide(now, sample)
        theirs.report_applied(drive.effort)
        assert (float(record.rules.last_effort),) == drive.effort
        assert _state(ours) == _state(theirs)
    assert theirs.saturated_periods > 0 or effort == 1.2


def test_a_disturbance_that_has_grown_old_stays_old() -> None:
    supervisor = _armed()
    later = _NOW + 60 * _MS
    assert supervisor.offer(Input.EFFORT_COMMAND, JointCommand(later, (0.5,), "/me", (JOINT,)), later) is None
    record = _lent(supervisor, JointSample.of_one(later, 1.0, 0.0))
    assert decide(record, later)
    assert record.rules.last_effort == 0.5
    take_back(supervisor, record.rules)
    # The clock is set back: what has ended does not begin again.
    assert supervisor.gates[Input.DISTURBANCE].fresh(_NOW) is None


def test_who_has_been_silent_for_too_long_begins_anew() -> None:
    supervisor = _armed(PlantLimits((2.0,), command_timeout=5.0))
    record = _lent(supervisor, JointSample.of_one(_NOW, 1.0, 0.0))
    assert not decide(record, _NOW + NANOSECONDS + 1)
    assert decide(record, _NOW + NANOSECONDS)


@pytest.mark.parametrize(
    ("position", "velocity"), [(math.inf, 0.0), (-math.inf, 0.0), (1.0, math.inf), (1.0, -math.inf)]
)
def test_an_infinite_measurement_is_no_ordinary_one_though_it_is_within_limits_that_are_none(
    position: float, velocity: float
) -> None:
    supervisor = _armed(PlantLimits((2.0,)))
    record = _lent(supervisor, JointSample.of_one(_NOW, position, velocity))
    assert not decide(record, _NOW + _MS)


def test_what_is_lent_again_counts_from_nothing() -> None:
    supervisor = _armed(PlantLimits((0.1,)))
    record = _lent(supervisor, JointSample.of_one(_NOW, 1.0, 0.0))
    record.inputs[0].stamp_ns, record.inputs[0].value[0] = _NOW + _MS, 0.5
    assert accept(record.inputs[0], record.rules.command, _NOW + _MS)
    assert decide(record, _NOW + _MS)
    assert lend(supervisor, record.rules)
    assert (record.rules.saturated, record.rules.decisions, record.rules.command.accepted) == (0, 0, 0)


def test_a_disturbance_that_had_grown_old_before_is_lent_so() -> None:
    supervisor = _armed(PlantLimits((2.0,)))
    assert supervisor.gates[Input.DISTURBANCE].fresh(_NOW + 60 * _MS) is None
    record = _lent(supervisor, JointSample.of_one(_NOW + _MS, 1.0, 0.0))
    assert decide(record, _NOW + _MS)
    assert record.rules.last_effort == 0.5


def test_a_loop_that_decided_nothing_changes_nothing() -> None:
    supervisor = _armed()
    record = _lent(supervisor, JointSample.of_one(_NOW, 1.0, 0.0))
    record.rules.last_effort, record.rules.commanded_ns, record.rules.decided_ns = 9.0, 1, 1
    take_back(supervisor, record.rules)
    assert _state(supervisor) == _state(_armed())


@settings(max_examples=300, deadline=None)
@given(stamp=_times, later=_times, effort=_numbers)
@example(stamp=2 * _MS, later=2 * _MS, effort=1.0)
@example(stamp=0, later=2 * _MS, effort=1.0)
@example(stamp=-2 * _MS, later=2 * _MS, effort=1.0)
@example(stamp=1, later=2 * _MS, effort=0.0)
@example(stamp=1, later=2 * _MS, effort=1e-9)
@example(stamp=1, later=2 * _MS, effort=-1e-9)
@example(stamp=2, later=2 * _MS, effort=0.0)
@example(stamp=2 * _MS, later=2 * _MS, effort=math.nan)
@example(stamp=2 * _MS, later=2 * _MS, effort=math.inf)
@example(stamp=10 * _MS, later=2 * _MS, effort=1.0)
@example(stamp=2 * _MS, later=60 * _MS, effort=1.0)
def test_a_command_is_accepted_as_its_gate_does(stamp: int, later: int, effort: float) -> None:
    ours, theirs = _armed(), _armed()
    record = _record()
    assert lend(ours, record.rules)
    before = bytes(record.rules)
    source = record.inputs[0]
    source.stamp_ns, source.value[0] = _NOW + stamp, effort
    taken = accept(source, record.rules.command, _NOW + later)
    command = JointCommand(_NOW + stamp, (effort,), "/me", (JOINT,))
    refusal = theirs.offer(Input.EFFORT_COMMAND, command, _NOW + later)
    assert taken == (refusal is None)
    if not taken:
        assert bytes(record.rules) == before
        return
    take_back(ours, record.rules)
    assert _state(ours) == _state(theirs)


def test_without_a_command_before_it_there_is_nothing_to_go_by() -> None:
    record = _record()
    record.inputs[0].stamp_ns = _NOW
    record.rules.command.newest_ns = NEVER
    record.rules.command.timeout_ns = 50 * _MS
    assert not accept(record.inputs[0], record.rules.command, _NOW)


def test_an_old_command_that_is_replaced_counts_again() -> None:
    supervisor = _armed()
    later = _NOW + 60 * _MS
    assert supervisor.gates[Input.EFFORT_COMMAND].fresh(later) is None
    record = _record()
    assert lend(supervisor, record.rules)
    assert not decide(record, later)
    record.sample_ns, record.position = later, 1.0
    record.inputs[0].stamp_ns, record.inputs[0].value[0] = later, 0.75
    assert accept(record.inputs[0], record.rules.command, later)
    assert decide(record, later)
    take_back(supervisor, record.rules)
    newest = supervisor.gates[Input.EFFORT_COMMAND].fresh(later)
    assert newest == JointCommand(later, (0.75,), "/me", (JOINT,))


def _disarmed(supervisor: PlantSupervisor) -> None:
    supervisor.disarm(_NOW)


def _stopped(supervisor: PlantSupervisor) -> None:
    supervisor.e_stop(_NOW)


def _faulted(supervisor: PlantSupervisor) -> None:
    supervisor.fault("broken", _NOW)


def _in_conflict(supervisor: PlantSupervisor) -> None:
    supervisor.set_commander_conflict("two of them")


def _pushed(supervisor: PlantSupervisor) -> None:
    assert supervisor.offer(Input.PUSH, JointCommand(_NOW, (1.0,), "/hand", (JOINT,)), _NOW) is None


def _starved(supervisor: PlantSupervisor) -> None:
    supervisor.decide(_NOW + 60 * _MS, JointSample.of_one(_NOW + 60 * _MS, 1.0, 0.0))


def _commanded_by_another(supervisor: PlantSupervisor) -> None:
    later = _NOW + 2 * NANOSECONDS
    command = JointCommand(later, (0.5,), "/another", (JOINT,))
    assert supervisor.offer(Input.EFFORT_COMMAND, command, later) is None


def _rearmed(supervisor: PlantSupervisor) -> None:
    supervisor.disarm(_NOW)
    assert supervisor.arm(_NOW, JointSample.of_one(_NOW, 1.0, 0.0)) == ""


@pytest.mark.parametrize(
    "happens",
    [_disarmed, _stopped, _faulted, _in_conflict, _pushed, _starved, _commanded_by_another, _rearmed],
    ids=lambda each: each.__name__.strip("_"),
)
def test_what_is_not_ordinary_is_not_lent(happens: Any) -> None:
    supervisor = _armed()
    assert lend(supervisor, _record().rules)
    happens(supervisor)
    assert not lend(supervisor, _record().rules)


def test_a_plant_that_was_never_commanded_is_not_lent() -> None:
    supervisor = PlantSupervisor(_LIMITS)
    assert supervisor.arm(_NOW, JointSample.of_one(_NOW, 1.0, 0.0)) == ""
    assert not lend(supervisor, _record().rules)


def test_a_push_that_has_grown_old_is_no_push() -> None:
    supervisor = _armed()
    _pushed(supervisor)
    later = _NOW + 60 * _MS
    command = JointCommand(later, (0.5,), "/me", (JOINT,))
    assert supervisor.offer(Input.EFFORT_COMMAND, command, later) is None
    supervisor.decide(later, JointSample.of_one(later, 1.0, 0.0))
    assert lend(supervisor, _record().rules)
