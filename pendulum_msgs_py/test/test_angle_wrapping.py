"""Angles: the one definition of where upright is and how angles wrap."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright, wrap

_FINITE = st.floats(-1e9, 1e9)


@given(_FINITE)
def test_wrapped_angles_lie_in_the_half_open_interval_and_point_the_same_way(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped < math.pi
    tolerance = 1e-9 + 4e-16 * abs(angle)
    assert abs(math.sin(wrapped) - math.sin(angle)) <= tolerance
    assert abs(math.cos(wrapped) - math.cos(angle)) <= tolerance


@given(st.floats(-math.pi, math.pi, exclude_max=True))
def test_angles_inside_come_back_bit_for_bit(angle: float) -> None:
    assert wrap(angle) == angle
    assert wrap(np.array([angle]))[0] == angle


@given(st.lists(st.one_of(_FINITE, st.just(math.nextafter(-math.pi, -4.0))), min_size=1))
def test_arrays_wrap_as_scalars_do(angles: list[float]) -> None:
    assert wrap(np.array(angles)).tolist() == [wrap(angle) for angle in angles]


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_what_is_no_angle_never_becomes_one(nothing: float) -> None:
    assert math.isnan(wrap(nothing))
    assert np.isnan(wrap(np.array([nothing]))).all()


def test_upright_is_zero_seen_from_upright_and_hanging_is_minus_pi() -> None:
    assert from_upright(UPRIGHT) == 0.0
    assert from_upright(0.0) == -math.pi
    assert from_upright(UPRIGHT + 0.1) == pytest.approx(0.1)
    assert from_upright(-UPRIGHT - 0.1) == pytest.approx(-0.1)
