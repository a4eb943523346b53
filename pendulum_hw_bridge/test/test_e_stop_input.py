"""What a button has to say, and how often, for the plant to go on."""

import pytest

from pendulum_hw_bridge.nodes.e_stop_input import EStopInput

MS = 1_000_000


def test_a_button_that_was_never_heard_stops() -> None:
    assert EStopInput(0.5).reason(10**12) == "e-stop button was never heard"


def test_a_press_stops_until_it_is_released() -> None:
    button = EStopInput(0.5)
    button.hear(pressed=False, now_ns=0)
    assert button.reason(100 * MS) == ""
    button.hear(pressed=True, now_ns=200 * MS)
    assert button.reason(200 * MS) == "e-stop button is pressed"
    button.hear(pressed=False, now_ns=300 * MS)
    assert button.reason(300 * MS) == ""


@pytest.mark.parametrize(("silence", "stops"), [(499, False), (500, False), (501, True), (60_000, True)])
def test_silence_stops_as_a_press_does(silence: int, stops: bool) -> None:
    button = EStopInput(0.5)
    button.hear(pressed=False, now_ns=7 * MS)
    reason = button.reason((7 + silence) * MS)
    assert bool(reason) is stops
    if stops:
        assert reason == f"e-stop button is silent for {silence} ms"


def test_two_who_publish_for_one_button_stop_whatever_they_say_and_a_press_is_reported_first() -> None:
    button = EStopInput(0.5)
    button.hear(pressed=False, now_ns=0)
    button.count(2)
    assert button.reason(0) == "2 publish for the e-stop button; expected one, whose silence is detectable"
    button.hear(pressed=True, now_ns=0)
    assert button.reason(0) == "e-stop button is pressed"
    button.hear(pressed=False, now_ns=0)
    button.count(1)
    assert button.reason(0) == ""
    button.count(0)
    assert button.reason(0) == ""
