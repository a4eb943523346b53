"""Which states are answered, and what is told about it."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.controller_interface.controller import BaseController, make_controller
from pendulum_lqr.nodes.answering import ControlLoop, StateRefusal
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.plants.plant_parameters import load_plant

THESIS = load_plant("thesis")
MS = 1_000_000
SECOND = 1_000_000_000
START = 1_000 * SECOND


def loop(**options):
    return ControlLoop(make_controller("lqr", THESIS, 0.01), 0.05, **options)


def sample(stamp_ns, angle=0.1, velocity=0.2):
    return JointSample.of_one(stamp_ns, math.pi + angle, velocity)


def test_each_new_state_is_answered_once_with_the_law():
    answering = loop()
    assert answering.answer(sample(START), START) == pytest.approx((-3.3663251,), abs=1e-6)
    assert answering.answer(sample(START), START) is None
    assert answering.refused == {StateRefusal.DUPLICATE: 1}
    assert answering.answered == 1


def test_an_answer_leaves_before_it_is_counted_and_what_is_refused_never_does():
    sent = []
    answering = loop(send=lambda state, effort: sent.append((state.stamp_ns, effort, answering.answered)))
    first = answering.answer(sample(START), START)
    assert sent == [(START, first, 0)]
    for refused in (sample(START), None, sample(START + 1, angle=math.nan), sample(START - 1)):
        assert answering.answer(refused, START) is None
    assert len(sent) == 1


def test_a_state_without_a_command_is_not_the_one_that_was_answered_last():
    class Fails(BaseController):
        def command(self, t, x):
            return math.nan if t else 1.0

    answering = ControlLoop(Fails(2.0), 0.05)
    assert answering.answered_ns is None
    assert answering.answer(sample(START), START) == (1.0,)
    assert answering.answer(sample(START + MS), START + MS) is None
    assert (answering.newest_stamp_ns, answering.answered_ns) == (START + MS, START)
    last = sample(START + 2 * MS)
    answering.count(last, (1.0,), answered=1, saturated=0, ages_ns=[0], compute_times_ns=[0])
    assert answering.answered_ns == START + 2 * MS
    answering.restart()
    assert answering.answered_ns is None


def test_in_lockstep_a_repeated_state_is_sent_the_same_answer_again():
    sent = []
    answering = loop(simulated_time=True, send=lambda state, effort: sent.append((state.stamp_ns, effort)))
    assert answering.answer(sample(START), START) == answering.answer(sample(START), START)
    assert sent[0] == sent[1]
    assert len(sent) == 2


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (None, StateRefusal.MALFORMED),
        (sample(START, angle=math.nan), StateRefusal.NOT_FINITE),
        (sample(START, velocity=math.inf), StateRefusal.NOT_FINITE),
        (sample(START - 51 * MS), StateRefusal.STALE),
        (sample(START + 51 * MS), StateRefusal.FROM_FUTURE),
        (sample(START - 11 * MS), StateRefusal.OUT_OF_ORDER),
    ],
)
def test_a_state_that_must_not_be_answered_is_refused_and_counted(state, reason):
    answering = loop()
    assert answering.answer(sample(START - 10 * MS), START) is not None
    assert answering.answer(state, START) is None
    assert answering.refused == {reason: 1}
    assert answering.summary(1)[f"refused.{reason.value}"] == 1
    # The next good state is answered as if nothing had been.
    assert answering.answer(sample(START), START) is not None


@given(st.lists(st.integers(-100 * MS, 100 * MS), max_size=30))
@settings(deadline=None)
def test_answers_have_increasing_stamps_whatever_comes(offsets):
    answering = loop()
    newest = -1
    for offset in offsets:
        if answering.answer(sample(START + offset), START) is not None:
            assert answering.newest_stamp_ns > newest
            newest = answering.newest_stamp_ns
    assert answering.answered + sum(answering.refused.values()) == len(offsets)


def test_simulated_time_has_no_age_and_a_repeated_state_gets_the_same_answer():
    answering = loop(simulated_time=True)
    first = answering.answer(sample(5 * SECOND), START)
    assert first == pytest.approx((-3.3663251,), abs=1e-6)
    assert answering.answer(sample(5 * SECOND), START) == first
    assert (answering.answered, answering.restarts) == (1, 0)


@given(
    st.integers(1, 3000),
    st.integers(1, 3000),
    st.floats(-0.05, 0.05),
)
@settings(deadline=None, max_examples=30)
def test_a_simulation_that_begins_anew_is_answered_as_by_a_new_controller(first_steps, start_step, angle):
    """However short the run before, and wherever in time the new one starts, also at its very first stamp."""
    answering = ControlLoop(make_controller("lqi", THESIS, 0.002), 0.05, simulated_time=True)
    for k in range(min(first_steps, 50)):
        answering.answer(sample(SECOND + (first_steps + k) * 2 * MS, 0.02), START)
    newest = answering.newest_stamp_ns
    begin = min(SECOND + start_step * 2 * MS, newest)
    fresh = ControlLoop(make_controller("lqi", THESIS, 0.002), 0.05, simulated_time=True)
    for k in range(5):
        state = sample(begin + k * 2 * MS, 0.3 + angle)
        assert answering.answer(state, START) == fresh.answer(state, START) is not None
    assert answering.restarts == 1


def test_a_refusal_says_which_field_is_wrong():
    answering = loop()
    answering.answer(None, START, "position has 0 values for 1 names; expected one for 'pendulum_joint'")
    assert answering.last_reason.startswith("position has 0 values")
    answering.answer(sample(START - 400 * MS), START)
    assert answering.last_reason == "header.stamp is 0.4 s old; expected at most 0.05 s"
    answering.answer(sample(START, velocity=math.inf), START)
    assert "velocity inf rad/s" in answering.last_reason


def test_a_controller_that_fails_or_answers_nonsense_gives_no_answer_and_a_reason():
    class Broken(BaseController):
        def command(self, t, x):
            if t > 0.0:
                return math.nan
            raise ZeroDivisionError("division by zero")

    answering = ControlLoop(Broken(1.0), 0.05)
    assert answering.answer(sample(START), START) is None
    assert "ZeroDivisionError: division by zero" in answering.last_reason
    assert answering.answer(sample(START + MS), START) is None
    assert answering.refused == {StateRefusal.NO_ANSWER: 2}


def test_a_repeated_state_that_had_no_answer_gets_none_and_not_that_of_the_state_before():
    class GivesUp(BaseController):
        def command(self, t, x):
            return 0.7 if t == 0.0 else math.nan

    answering = ControlLoop(GivesUp(1.0), 0.05, simulated_time=True)
    assert answering.answer(sample(START), START) == (0.7,)
    for _ in range(2):
        assert answering.answer(sample(START + MS), START) is None
    assert answering.refused == {StateRefusal.NO_ANSWER: 1, StateRefusal.DUPLICATE: 1}


def test_time_counts_from_the_first_state():
    times = []

    class Watch(BaseController):
        def command(self, t, x):
            times.append(t)
            return 0.0

    answering = ControlLoop(Watch(1.0), 0.05)
    for k in range(3):
        answering.answer(sample(START + k * 10 * MS), START + k * 10 * MS)
    answering.restart()
    answering.answer(sample(START + 40 * MS), START + 40 * MS)
    assert times == pytest.approx([0.0, 0.01, 0.02, 0.0])


def test_diagnostics_tell_rate_saturation_age_and_compute_time():
    answering = loop()
    answering.summary(SECOND)
    for k in range(10):
        answering.answer(sample(START + k * 10 * MS, angle=1.0 if k < 4 else 0.0), START + k * 10 * MS + 2 * MS)
    told = answering.summary(SECOND + 100 * MS)
    assert told["answer_rate_hz"] == pytest.approx(100.0)
    assert told["saturation_share"] == pytest.approx(0.4)
    assert told["state_age_p50_us"] == pytest.approx(2000.0)
    assert 0.0 < told["compute_time_p50_us"] < 1000.0
    assert answering.summary(SECOND + 200 * MS)["saturation_share"] == 0.0


def test_a_new_controller_takes_over_between_two_states():
    answering = ControlLoop(make_controller("lqi", THESIS, 0.01), 0.05)
    for k in range(100):
        answering.answer(sample(START + k * 10 * MS, 0.01, 0.0), START + k * 10 * MS)
    before = answering.last_effort
    answering.replace(make_controller("lqi", THESIS, 0.01))
    after = answering.answer(sample(START + SECOND, 0.01, 0.0), START + SECOND)
    assert after == pytest.approx(before, abs=0.02)
