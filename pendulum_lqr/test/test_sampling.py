"""The rate of the states: measured, heeded, and refused where a controller does not bear it."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.controller_interface.controller import (
    BaseController,
    controller_class,
    controller_names,
    make_controller,
)
from pendulum_lqr.controller_interface.loop_check import settles
from pendulum_lqr.controller_interface.sampling import PeriodWatch, differs, rate_problem
from pendulum_lqr.linear.analysis import delayed_spectral_radius
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.plants.plant_parameters import load_plant

MS = 1_000_000
DFKI = load_plant("dfki")
THESIS = load_plant("thesis")


def problem(kind, plant, designed, measured, **values):
    known = controller_class(kind)
    return rate_problem(
        known,
        kind,
        lambda: make_controller(kind, plant, designed, values),
        plant,
        designed,
        measured,
        uses=known.SAMPLED,
    )


@given(
    st.sampled_from([500.0, 300.0, 100.0, 50.0]),
    st.lists(st.floats(-0.2, 0.2), min_size=30, max_size=30),
    st.lists(st.integers(1, 29), max_size=5, unique=True),
)
@settings(deadline=None)
def test_the_period_is_measured_through_jitter_and_losses(rate, jitter, lost):
    watch = PeriodWatch()
    period = 1e9 / rate
    known = []
    for k, share in enumerate(jitter):
        if k not in lost:
            watch.add(10**18 + round(k * period + share * 0.3 * period))
            known.append(watch.period)
    assert known[:9] == [None] * 9
    assert not differs(known[-1], 1.0 / rate)


def test_in_lockstep_one_interval_says_it_and_a_new_simulation_may_run_at_another_rate():
    watch = PeriodWatch(exact=True)
    assert not watch.add(10**9)
    assert watch.period is None
    assert not watch.add(10**9 + 2 * MS)
    assert watch.period == 0.002
    # A state that is repeated is no interval.
    assert not watch.add(10**9 + 2 * MS)
    assert watch.add(10**9)
    assert watch.period is None
    watch.add(10**9 + 10 * MS)
    assert watch.period == 0.01


def test_a_plant_that_comes_back_after_a_while_is_measured_anew():
    watch = PeriodWatch()
    for k in range(10):
        watch.add(k * 10 * MS)
    assert watch.period == 0.01
    assert watch.add(5 * 10**9)
    assert watch.period is None


def test_pid_with_both_defaults_is_refused_where_it_was_seen_to_oscillate_and_not_at_its_own_rate():
    message = problem("pid", DFKI, 0.01, 0.002)
    assert message == (
        "period is 0.01 s, but states come every 0.002 s, at which pid designed for the former does not settle; "
        "expected period:=0.002, or 0 to take it from the states"
    )
    assert "states come every 0.02 s" in problem("pid", DFKI, 0.002, 0.02)
    assert problem("pid", DFKI, 0.01, 0.01) == problem("pid", DFKI, 0.002, 0.002) == ""
    # Heavy damping forgives it.
    assert problem("pid", THESIS, 0.01, 0.002) == ""


def test_what_is_refused_does_not_hold_the_nonlinear_plant_and_what_is_not_does(simulate):
    for designed, measured in ((0.01, 0.002), (0.002, 0.02), (0.01, 0.01), (0.002, 0.002)):
        controller = make_controller("pid", DFKI, designed)
        smooth = DFKI.with_values(coulomb_friction=0.0, static_friction=0.0, effort_limit=20.0)
        run = simulate(smooth, controller, theta=math.pi + 0.01, period=measured, duration=3.0)
        holds = np.abs(run.angle[run.t > 2.5]).max() < 0.01
        assert holds == (problem("pid", DFKI, designed, measured) == ""), (designed, measured)


def test_a_continuous_design_is_refused_where_the_plant_is_too_slow_for_it():
    q = [100.0, 0.01]
    assert problem("lqr", DFKI, 0.01, 0.01, q=q, r=0.1) == ""
    assert "lqr does not settle on plant 'dfki'" in problem("lqr", DFKI, 0.01, 0.2, q=q, r=0.1)


def test_a_controller_that_is_not_meant_to_balance_is_left_alone():
    assert problem("pid", DFKI, 0.01, 0.002, tuning="manual", kp=0.0, ki=0.0, kd=0.0) == ""
    assert problem("energy_swing_up", DFKI, 0.01, 0.1) == ""


@pytest.mark.parametrize("kind", ["lqr", "pd_gravity", "sliding_mode", "energy_swing_up"])
def test_who_is_said_to_ignore_the_period_does(kind):
    assert not controller_class(kind).SAMPLED
    fast, slow = (make_controller(kind, DFKI, period) for period in (0.002, 0.02))
    for k, x in enumerate([(0.1, 0.2), (-0.3, 1.0), (3.0, -2.0), (0.01, 0.0)]):
        assert fast.command(0.01 * k, x) == slow.command(0.01 * k, x)


def test_who_depends_on_the_period_is_known():
    assert {kind for kind in controller_names() if controller_class(kind).SAMPLED} == {
        "lqi",
        "lqg",
        "lqr_friction",
        "lqr_tracking",
        "discrete_lqr",
        "pid",
        "time_optimal",
        "tvlqr",
        "mpc",
        "nmpc",
        "policy",
    }
    fast, slow = (make_controller("discrete_lqr", THESIS, period) for period in (0.002, 0.02))
    assert fast.command(0.0, (0.1, 0.2)) != slow.command(0.0, (0.1, 0.2))


def test_a_balancing_controller_settles_at_a_set_point_too():
    controller = make_controller("lqr", DFKI, 0.01, {"set_point": 0.3})
    assert settles(controller, DFKI, 0.01, 0.3)
    assert not settles(make_controller("pid", DFKI, 0.01, {"set_point": 0.3}), DFKI, 0.002, 0.3)


@pytest.mark.parametrize("lag", [0.0, 0.02])
def test_a_law_that_is_no_known_gain_is_refused_within_a_ten_thousandth_of_the_spectral_radius_at_which_its_gain_is(
    lag: float,
) -> None:
    class Followed(BaseController):
        def command(self, t: float, x: Sequence[float]) -> float:
            return -K[0] * x[0] - K[1] * x[1]

    K = tuple(map(float, output_lqr(linearise(DFKI.with_values(actuator_time_constant=lag)), (100.0, 0.01), 0.1).K))
    for radius_above in (True, False):
        low, high = 0.0, 0.1
        while True:
            middle = 0.5 * (low + high)
            plant = DFKI.with_values(actuator_time_constant=lag, transport_delay=middle)
            radius = delayed_spectral_radius(linearise(plant), K, 0.01)
            if 2e-5 < (radius - 1.0 if radius_above else 1.0 - radius) < 1e-4:
                break
            low, high = (low, middle) if radius > (1.00006 if radius_above else 0.99994) else (middle, high)
        assert settles(Followed(1.5), plant, 0.01) != radius_above
