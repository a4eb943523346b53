"""The order to stop: whom it asks, how long, what it shows, and when it ends."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from pendulum_console.console.stop_order import ASK_AGAIN, SILENT_AFTER, StopOrder

SIM, HW = "/sim/simulator", "/hw/bridge"


def test_nobody_is_asked_before_a_press() -> None:
    order = StopOrder()
    assert order.due([SIM], 0.0) == []
    assert order.state(0.0) is None
    assert not order.in_force


def test_a_plant_that_does_not_answer_is_asked_again_until_it_does() -> None:
    order = StopOrder()
    order.press([SIM], 10.0)
    asked = [step / 100 for step in range(300) if order.due([SIM], 10.0 + step / 100)]
    assert asked[0] == 0.0
    assert max(later - before for before, later in pairwise(asked)) <= ASK_AGAIN + 0.011
    state = order.state(13.0)
    assert state is not None
    assert state["rows"][SIM]["state"] == "asked"
    assert state["rows"][SIM]["silent_for"] == 3.0
    order.answer(SIM, "e-stop latched", 13.0)
    state = order.state(13.1)
    assert state is not None
    assert state["rows"][SIM] == {"state": "stopped", "after": 3.0, "silent_for": 0.1, "text": "e-stop latched"}


def test_a_plant_out_of_reach_when_the_stop_was_pressed_is_asked_when_it_is_back() -> None:
    order = StopOrder()
    order.press([SIM, HW], 0.0)
    order.answer(SIM, "stopped", 0.1)
    for step in range(100):
        order.due([SIM], 0.1 + step / 10)
        order.answer(SIM, "stopped", 0.1 + step / 10)
    assert HW in order.due([SIM], 11.0)
    state = order.state(11.0)
    assert state is not None
    assert state["rows"][HW]["state"] == "asked"


def test_a_plant_that_comes_while_the_order_stands_is_stopped_too() -> None:
    order = StopOrder()
    order.press([], 0.0)
    assert order.due([SIM], 5.0) == [SIM]


def test_a_plant_that_has_answered_is_asked_on_in_case_it_is_started_anew() -> None:
    order = StopOrder()
    order.press([SIM], 0.0)
    order.due([SIM], 0.0)
    order.answer(SIM, "stopped", 0.05)
    assert order.due([SIM], 0.4) == []
    assert order.due([SIM], 0.6) == [SIM]
    state = order.state(0.05 + SILENT_AFTER)
    assert state is not None
    assert state["rows"][SIM]["state"] == "silent"


def test_an_order_is_acknowledged_only_for_those_that_answer() -> None:
    order = StopOrder()
    order.press([SIM, HW], 0.0)
    order.answer(SIM, "stopped", 0.1)
    assert order.acknowledge(0.2) == [HW]
    assert order.in_force
    assert order.due([SIM, HW], 0.5) == [HW], "who was acknowledged is left alone, the other is asked on"
    order.answer(HW, "stopped", 0.6)
    assert order.acknowledge(0.7) == []
    assert not order.in_force
    assert order.due([SIM, HW], 9.0) == []


def test_a_new_press_asks_everybody_again_also_those_left_alone() -> None:
    order = StopOrder()
    order.press([SIM, HW], 0.0)
    order.release(SIM)
    assert order.due([SIM, HW], 0.1) == [HW]
    order.press([SIM, HW], 1.0)
    assert sorted(order.due([SIM, HW], 1.0)) == [HW, SIM]


def test_an_order_without_plants_ends_when_it_is_acknowledged() -> None:
    order = StopOrder()
    order.press([], 0.0)
    assert order.acknowledge(0.1) == []
    assert not order.in_force


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["press", "answer", "due", "acknowledge", "release", "problem"]),
            st.sampled_from([SIM, HW]),
            st.floats(0.0, 2.0),
        ),
        max_size=40,
    )
)
def test_no_sequence_of_events_loses_a_plant_that_has_not_answered(steps: list[tuple[str, str, float]]) -> None:
    """Whoever was on the graph at a press and did not answer since is still shown, and is asked within 0.2 s."""
    order, now = StopOrder(), 0.0
    owed: set[str] = set()
    for what, plant, wait in steps:
        now += wait
        if what == "press":
            order.press([SIM, HW], now)
            owed = {SIM, HW}
        elif what == "answer":
            order.answer(plant, "stopped", now)
            owed.discard(plant)
        elif what == "due":
            order.due([plant], now)
        elif what == "acknowledge":
            order.acknowledge(now)
        elif what == "problem":
            order.problem(plant, "out of reach")
        else:
            order.release(plant)
            owed.discard(plant)
        state = order.state(now)
        shown = set(state["rows"]) if state else set()
        assert owed <= shown
    # A sum of floats may fall short by a rounding.
    assert owed <= set(order.due([], now + ASK_AGAIN + 1e-9))


def test_a_stop_of_one_plant_is_asked_again_like_that_of_all_and_leaves_the_others_alone() -> None:
    order = StopOrder()
    order.press_one(SIM, 0.0)
    assert order.due([SIM, HW], 0.0) == [SIM]
    assert order.due([SIM, HW], ASK_AGAIN + 0.01) == [SIM]
    order.press([SIM, HW], 1.0)
    order.press_one(SIM, 1.1)
    assert sorted(order.due([SIM, HW], 1.1)) == [HW, SIM], "a stop of all stays one of all"
