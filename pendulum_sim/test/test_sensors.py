"""Sensors: each error by itself, off by default, drawn from a generator of its own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.stepping.sensors import Sensors, quantise


def _measure(count: int = 20_000, **parameters: float) -> tuple[np.ndarray, Sensors]:
    sensors = Sensors(np.random.default_rng(7), **parameters)
    samples = [sensors.measure(k, (1.0,), (-2.0,), (0.5,)) for k in range(count)]
    return np.array([s.position + s.velocity + s.effort for s in samples if s is not None]), sensors


def test_without_parameters_the_measurement_is_the_state() -> None:
    sample = Sensors().measure(5, (1.25,), (-0.5,), (3.0,))
    assert sample is not None
    assert sample == (5, (1.25,), (-0.5,), (3.0,))


@given(value=st.floats(-1e3, 1e3), step=st.floats(1e-6, 1.0))
def test_quantisation_is_off_by_half_a_step_at_most(value: float, step: float) -> None:
    rounded = quantise(value, step)
    assert abs(rounded - value) <= 0.5 * step * (1 + 1e-9)
    assert rounded / step == pytest.approx(round(rounded / step), abs=1e-6)


def test_bias_and_noise_have_the_size_asked_for() -> None:
    values, _ = _measure(position_bias=0.1, velocity_noise=0.059, effort_noise=0.2)
    assert np.ptp(values[:, 0]) == 0.0
    assert values[0, 0] == pytest.approx(1.1)
    assert values[:, 1].mean() == pytest.approx(-2.0, abs=2e-3)
    assert values[:, 1].std() == pytest.approx(0.059, rel=0.03)
    assert values[:, 2].std() == pytest.approx(0.2, rel=0.03)


def test_jitter_moves_the_angle_along_its_velocity() -> None:
    values, _ = _measure(jitter=1e-3)
    assert values[:, 0].std() == pytest.approx(2.0 * 1e-3, rel=0.03)
    assert np.ptp(values[:, 1]) == 0.0


def test_the_share_of_lost_samples_is_the_drop_rate() -> None:
    values, sensors = _measure(drop_rate=0.2)
    assert sensors.dropped == 20_000 - len(values)
    assert sensors.dropped / 20_000 == pytest.approx(0.2, abs=0.015)


def test_switching_one_error_on_leaves_the_numbers_of_the_others() -> None:
    alone, _ = _measure(100, velocity_noise=0.1)
    together, _ = _measure(100, velocity_noise=0.1, position_noise=0.3, jitter=1e-3, effort_step=0.1)
    assert np.array_equal(alone[:, 1], together[:, 1])


def test_one_seed_gives_one_series() -> None:
    first, _ = _measure(50, position_noise=0.1, drop_rate=0.3)
    second, _ = _measure(50, position_noise=0.1, drop_rate=0.3)
    assert np.array_equal(first, second)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"position_nois": 0.1}, "unknown parameter 'position_nois'; did you mean 'position_noise'"),
        ({"drop_rate": 1.5}, "drop_rate is 1.5; expected 0 to 1"),
        ({"velocity_noise": -1.0}, "velocity_noise is -1.0 rad/s; expected >= 0"),
    ],
)
def test_parameters_outside_their_domain_are_refused(parameters: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Sensors(**parameters)
