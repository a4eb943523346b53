"""A hot winding gets less torque before it gets none."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_hw_bridge.drive.derating import Derating
from pendulum_msgs_py.errors import ParameterError


@pytest.mark.parametrize(
    ("temperature", "share"), [(20.0, 1.0), (100.0, 1.0), (105.0, 0.75), (115.0, 0.25), (120.0, 0.0), (150.0, 0.0)]
)
def test_the_limit_falls_in_proportion_from_the_start_to_the_cut_off(temperature: float, share: float) -> None:
    derating = Derating(100.0, 120.0)
    assert derating.share(temperature) == pytest.approx(share)
    assert derating.clamp(9.0, 8.0, temperature) == pytest.approx(8.0 * share)
    assert derating.clamp(-9.0, 8.0, temperature) == pytest.approx(-8.0 * share)


def test_without_a_start_nothing_is_taken_and_a_missing_temperature_is_for_others_to_name() -> None:
    assert Derating(0.0, 120.0).share(119.0) == 1.0
    assert Derating(100.0, 120.0).share(math.nan) == 1.0


@given(st.floats(-20.0, 20.0), st.floats(0.0, 13.0), st.floats(-40.0, 200.0), st.floats(1.0, 119.0))
def test_derating_never_raises_a_torque_nor_turns_it_round(
    effort: float, limit: float, temperature: float, start: float
) -> None:
    clamped = Derating(start, 120.0).clamp(effort, limit, temperature)
    assert abs(clamped) <= min(abs(effort), limit)
    assert clamped * effort >= 0.0


@pytest.mark.parametrize("start", [120.0, 130.0, -5.0])
def test_a_derating_that_begins_after_the_cut_off_is_refused(start: float) -> None:
    with pytest.raises(ParameterError, match="derating_temperature is"):
        Derating(start, 120.0)
