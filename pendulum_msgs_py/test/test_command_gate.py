"""The gate: which commands a plant believes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.contract.commands import CommandGate, Refusal
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.rules import COMMANDER_HOLD
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand

_MS = 1_000_000
_NOW = 1_000 * NANOSECONDS


def _gate() -> CommandGate:
    return CommandGate(0.05)


def _command(age_ms: float = 0.0, effort: float = 1.0, source: str = "lqr", joints: tuple = (JOINT,)) -> JointCommand:
    return JointCommand.of_one(_NOW - round(age_ms * _MS), effort, source, joints)


@pytest.mark.parametrize(
    ("command", "refusal"),
    [
        (_command(), None),
        (_command(joints=()), None),
        (_command(age_ms=50.0), None),
        (_command(age_ms=-5.0), None),
        (_command(effort=1e308), None),
        (_command(age_ms=50.001), Refusal.TOO_OLD),
        (_command(age_ms=-5.001), Refusal.FROM_FUTURE),
        (_command(effort=math.nan), Refusal.NOT_FINITE),
        (_command(effort=-math.inf), Refusal.NOT_FINITE),
        (_command(joints=("elbow",)), Refusal.OTHER_JOINT),
        (_command(joints=(JOINT, "elbow")), Refusal.NOT_ONE_JOINT),
        (JointCommand.of_one(0, 1.0), Refusal.TOO_OLD),
        (JointCommand.of_one(-1, 1.0), Refusal.TOO_OLD),
    ],
)
def test_each_rule_refuses_and_counts_under_its_own_name(command: JointCommand, refusal: Refusal | None) -> None:
    gate = _gate()
    assert gate.offer(command, _NOW) is refusal
    assert gate.accepted == (refusal is None)
    assert dict(gate.refused) == ({} if refusal is None else {refusal: 1})
    assert (gate.fresh(_NOW) is command) == (refusal is None)


@pytest.mark.parametrize(
    ("after_ns", "effort", "ends"), [(1, 0.0, True), (1, -0.0, True), (2, 0.0, False), (1, 1e-9, False)]
)
def test_a_zero_right_behind_a_command_ends_it_at_once_and_the_next_one_counts_again(
    after_ns: int, effort: float, ends: bool
) -> None:
    gate = _gate()
    last = JointCommand.of_one(_NOW - _MS + after_ns, effort, "lqr")
    # The first of all follows none.
    assert gate.offer(last._replace(stamp_ns=_NOW - 2 * _MS, effort=(0.0,)), _NOW) is None
    assert gate.fresh(_NOW) is not None
    assert gate.offer(_command(age_ms=1.0), _NOW) is None
    assert gate.offer(last, _NOW) is None
    assert (gate.fresh(_NOW), gate.newest, gate.accepted) == (None if ends else last, last, 3)
    assert gate.offer(_command(), _NOW) is None
    assert gate.fresh(_NOW) == _command()


def test_a_zero_of_several_joints_ends_where_each_of_them_is_zero() -> None:
    for effort, ends in (((0.0, 0.0), True), ((0.0, 1.0), False)):
        gate = CommandGate(0.05, joints=("a", "b"))
        for stamp_ns, each in ((_NOW, (1.0, 1.0)), (_NOW + 1, effort)):
            assert gate.offer(JointCommand(stamp_ns, each, "lqr", ("a", "b")), _NOW) is None
        assert (gate.fresh(_NOW) is None) is ends


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (_command(age_ms=412.0), "header.stamp is 0.412 s before the plant's time; expected at most 0.05 s"),
        (_command(age_ms=-20.0), "header.stamp is 0.02 s after the plant's time; expected at most 0.005 s"),
        (_command(effort=math.nan), "effort is nan N m; expected a finite number"),
        (_command(joints=("elbow",)), f"name is ['elbow']; expected [{JOINT!r}] or none"),
        (_command(joints=(JOINT, "elbow")), f"name is [{JOINT!r}, 'elbow']; expected [{JOINT!r}] or none"),
        (_command(age_ms=1.0), "header.stamp is that of the command before; expected one answer to a state"),
        (_command(age_ms=4.0), "header.stamp is 0.003 s before that of the command before"),
        (_command(source="pid"), "header.frame_id is 'pid'; 'lqr' commands"),
    ],
)
def test_a_refusal_says_which_field_is_wrong_and_what_was_expected(command: JointCommand, problem: str) -> None:
    gate = _gate()
    gate.offer(_command(age_ms=1.0), _NOW)
    refusal = gate.offer(command, _NOW)
    assert refusal is not None
    assert gate.problems == {refusal: problem}


def test_a_second_answer_to_one_state_and_an_older_one_are_refused() -> None:
    gate = _gate()
    gate.offer(_command(age_ms=10.0), _NOW)
    assert gate.offer(_command(age_ms=10.0, effort=2.0), _NOW) is Refusal.DUPLICATE
    assert gate.offer(_command(age_ms=11.0), _NOW) is Refusal.OUT_OF_ORDER
    assert gate.fresh(_NOW).effort[0] == 1.0


def test_a_second_commander_waits_until_the_first_is_silent() -> None:
    gate = _gate()
    gate.offer(_command(), _NOW)
    later = _NOW + round(COMMANDER_HOLD * NANOSECONDS)
    assert gate.offer(JointCommand.of_one(later, 5.0, "other"), later) is Refusal.SECOND_COMMANDER
    assert gate.refused_commander == "other"
    later += 1
    assert gate.offer(JointCommand.of_one(later, 5.0, "other"), later) is None
    assert gate.commander == "other"
    assert gate.offer(JointCommand.of_one(later + 1, 5.0, "lqr"), later + 1) is Refusal.SECOND_COMMANDER


def test_bad_commands_of_the_holder_do_not_keep_its_place() -> None:
    gate = _gate()
    gate.offer(_command(), _NOW)
    for step in range(1, 25):
        gate.offer(JointCommand.of_one(_NOW + step * 50 * _MS, math.nan, "lqr"), _NOW + step * 50 * _MS)
    later = _NOW + 1300 * _MS
    assert gate.offer(JointCommand.of_one(later, 1.0, "other"), later) is None


def test_a_reset_forgets_the_commander_and_keeps_the_counts() -> None:
    gate = _gate()
    gate.offer(_command(), _NOW)
    gate.refuse_malformed()
    gate.reset()
    assert gate.fresh(_NOW) is None
    assert gate.newest_stamp_ns is None
    assert gate.offer(_command(source="other"), _NOW) is None
    assert gate.refused[Refusal.NOT_ONE_JOINT] == 1


def test_after_the_clock_stepped_back_commands_are_believed_again() -> None:
    gate = _gate()
    gate.offer(_command(), _NOW)
    before = _NOW - 3600 * NANOSECONDS
    assert gate.fresh(before) is None
    assert gate.offer(JointCommand.of_one(before, 2.0, "lqr"), before) is None
    assert gate.fresh(before).effort[0] == 2.0


@given(
    st.lists(
        st.tuples(
            st.integers(-(10**9), 10**9),
            st.integers(-100 * _MS, 100 * _MS),
            st.floats(),
            st.sampled_from(["a", "b", ""]),
        ),
        max_size=30,
    )
)
def test_what_is_fresh_is_always_finite_and_young_by_stamp_and_by_hearing(
    events: list[tuple[int, int, float, str]],
) -> None:
    gate = _gate()
    now = heard = _NOW
    for step, age, effort, source in events:
        now += step
        if gate.offer(JointCommand.of_one(now - age, effort, source), now) is None:
            heard = now
        for later in (now, now + 20 * _MS, now + 60 * _MS):
            fresh = gate.fresh(later)
            if fresh is not None:
                assert math.isfinite(fresh.effort[0])
                assert -5 * _MS <= later - fresh.stamp_ns <= 50 * _MS
                # A plant that catches up with missed periods decides as of times before it heard the command.
                assert -50 * _MS <= later - heard <= 50 * _MS
    assert gate.accepted + sum(gate.refused.values()) == len(events)


@pytest.mark.parametrize("step_ms", [-100.0, -60.0, 60.0, 1000.0])
def test_a_command_that_has_grown_old_stays_old_whatever_the_clock_does_then(step_ms: float) -> None:
    gate = _gate()
    assert gate.offer(_command(), _NOW) is None
    assert gate.fresh(_NOW + round(step_ms * _MS)) is None
    assert all(gate.fresh(_NOW + 5 * step * _MS) is None for step in range(-20, 20))
    assert gate.offer(_command(age_ms=-10.0), _NOW + 10 * _MS) is None
    assert gate.fresh(_NOW + 11 * _MS) is not None, "a new command is believed again"


def test_a_gate_begins_with_nobody_and_is_with_nobody_after_a_reset() -> None:
    gate = _gate()
    assert gate.commander == ""
    assert gate.refused_commander == ""
    gate.offer(_command(), _NOW)
    assert gate.commander == "lqr"
    gate.reset()
    assert gate.commander == ""


def test_a_message_that_is_no_command_is_refused_with_what_was_wrong_in_it() -> None:
    gate = _gate()
    assert gate.refuse_malformed("effort has 2 values; expected 1") is Refusal.NOT_ONE_JOINT
    assert gate.problems == {Refusal.NOT_ONE_JOINT: "effort has 2 values; expected 1"}


def test_a_command_as_far_ahead_as_allowed_still_orders_what_comes_after_it() -> None:
    gate = _gate()
    gate.offer(_command(age_ms=-5.0), _NOW)
    assert gate.offer(_command(age_ms=-4.0), _NOW) is Refusal.OUT_OF_ORDER
