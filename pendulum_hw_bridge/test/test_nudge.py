"""A nudge and the feedback that shows it: what counts as a turn, what is said to whom, and how soon silence is told."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.checks.nudge import EmulatedHand, Person, hand_of, watch_nudge
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import ActuatorError, Feedback
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.feedback_stream import feedback_for


class Scripted:
    """An actuator whose angles are given, one for each look; None for a look without a record."""

    def __init__(self, angles: Iterator[float | None]) -> None:
        port = EmulatorBackend(EmulatedX5(load_emulator("thesis"), seed=1), SteppedClock())
        port.connect()
        record = port.read(0.1)
        assert record is not None
        self._record, self._angles = record, angles
        self.time_ns = 1_700_000_000_000_000_000

    def now_ns(self) -> int:
        return self.time_ns

    def read(self, timeout: float) -> Feedback | None:
        self.time_ns += round(timeout * 1e9)
        angle = next(self._angles)
        return None if angle is None else self._record._replace(position=angle)


def always(angle: float | None) -> Iterator[float | None]:
    while True:
        yield angle


def after(*first: float | None, then: float | None) -> Iterator[float | None]:
    yield from first
    yield from always(then)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_turn_of_more_than_six_degrees_counts_and_none_of_less(way: float) -> None:
    said: list[str] = []
    port = Scripted(after(0.0, 0.05 * way, 0.1 * way, then=0.1001 * way))
    assert watch_nudge(port, Person(said.append)) == pytest.approx(0.1001 * way)  # type: ignore[arg-type]
    assert said[-1] == "Seen; let go."
    assert watch_nudge(Scripted(after(0.0, then=0.1 * way)), Person(said.append)) == 0.0  # type: ignore[arg-type]
    assert said[-1] == "Nothing was seen; let go."


def test_a_turn_is_measured_from_where_the_link_was_and_waited_for_half_a_minute() -> None:
    assert watch_nudge(Scripted(after(2.0, then=2.2)), Person(lambda _: None)) == pytest.approx(0.2)  # type: ignore[arg-type]
    port = Scripted(always(2.0))
    begin_ns = port.now_ns()
    assert watch_nudge(port, Person(lambda _: None)) == 0.0  # type: ignore[arg-type]
    assert (port.now_ns() - begin_ns) / 1e9 == pytest.approx(30.0, abs=0.1)


def test_a_person_is_asked_for_one_way_and_releases_a_module_that_has_gone() -> None:
    said: list[str] = []
    port = Scripted(always(None))
    with pytest.raises(ActuatorError, match="no feedback for 1 s"):
        watch_nudge(port, hand_of(port, said.append))  # type: ignore[arg-type]
    assert "a little COUNTER-CLOCKWISE as you look at it" in said[0]
    assert "no torque" in said[0]
    assert said[1:] == ["Nothing was seen; let go."]
    hand_of(port, said.append, clockwise=True).begin()  # type: ignore[arg-type]
    assert "a little CLOCKWISE as you look at it" in said[-1]


def test_an_emulated_hand_pushes_one_way_and_releases() -> None:
    port = EmulatorBackend(EmulatedX5(load_emulator("thesis"), seed=1), SteppedClock())
    pushed: list[float] = []
    port.push = pushed.append  # type: ignore[method-assign]
    for clockwise in (False, True):
        hand = hand_of(port, lambda _: None, clockwise=clockwise)
        assert isinstance(hand, EmulatedHand)
        hand.begin()
        hand.end()
    assert pushed == [6.0, 0.0, -6.0, 0.0]


def test_feedback_is_heard_for_its_time_and_no_longer() -> None:
    assert len(list(feedback_for(Scripted(always(0.0)), 1.0))) == 20  # type: ignore[arg-type]


def test_silence_of_a_second_is_reported_and_counts_from_the_last_record() -> None:
    port = Scripted(after(0.0, None, None, 0.0, then=None))
    begin_ns, heard = port.now_ns(), list[Feedback]()
    with pytest.raises(ActuatorError, match="no feedback for 1 s; expected it to flow: is the module still there"):
        heard.extend(feedback_for(port, 30.0))  # type: ignore[arg-type]
    assert len(heard) == 2
    # Four looks of 50 ms, then silence of more than a second.
    assert port.now_ns() - begin_ns == 1_250_000_000
