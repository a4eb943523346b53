"""Gains against the thesis, closed forms, scipy and python-control; refusals; margins against simulation."""

import math
from itertools import pairwise

import control
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.linear.analysis import analyse, delayed_spectral_radius, largest_stable_period, loop_margins
from pendulum_lqr.linear.design import (
    DesignError,
    continuous_lqr,
    kalman_gain,
    output_lqr,
    require_controllable,
    require_observable,
    with_integrals,
)
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_lqr.linear.sampled_design import DiscreteModel, discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.plants.plant_parameters import load_plant, pendulum_plant

THESIS = load_plant("thesis")
UPRIGHT = linearise(THESIS)
PLANTS = st.builds(
    pendulum_plant,
    inertia=st.floats(0.01, 1.0),
    damping=st.floats(0.0, 12.0),
    gravity=st.floats(0.1, 5.0),
)
WEIGHTS = st.tuples(st.floats(0.1, 100.0), st.floats(0.01, 10.0))


@pytest.mark.parametrize(
    ("q", "r", "printed", "computed"),
    [
        ((1.0, 0.01), 0.1, ("-0.30", "-214.22"), (-0.303843, -214.219476)),
        ((1.0, 0.1), 0.1, ("-0.30", "-214.91"), (-0.302863, -214.912785)),
        ((100.0, 0.01), 0.1, ("-2.69", "-214.20"), (-2.687959, -214.202827)),
        ((100.0, 0.1), 0.1, ("-2.68", "-214.90"), (-2.679285, -214.896296)),
    ],
)
def test_eigenvalues_of_the_thesis_to_its_last_digit(q, r, printed, computed):
    poles = continuous_lqr(UPRIGHT, q, r).poles
    assert tuple(f"{pole.real:.2f}" for pole in poles) == printed
    np.testing.assert_allclose(poles, computed, atol=5e-7)


def test_gain_and_time_constant_of_the_thesis():
    gain = continuous_lqr(UPRIGHT, (100.0, 0.01), 0.1)
    np.testing.assert_allclose(gain.K, [33.345265, 0.158993], atol=5e-7)
    report = analyse(UPRIGHT, gain.K)
    assert report.time_constant == pytest.approx(0.372029, abs=1e-6)
    assert round(1.0 / round(-report.poles[0].real, 2), 4) == 0.3717


X5_9 = load_plant("x5_9")


def test_the_gain_for_a_rigid_plant_and_that_of_the_series_elastic_one_on_the_plant_that_runs():
    # The rigid link alone, as if there were no drivetrain: unstable on the true plant, whose gain may only shrink.
    model = linearise(X5_9)
    rigid = continuous_lqr(linearise(X5_9.with_values(drivetrain=None)), (100.0, 0.01), 0.1)
    wrong = analyse(model, rigid.K)
    assert not wrong.stable
    assert wrong.poles[0].real == pytest.approx(0.3145, abs=1e-3)
    assert abs(wrong.poles[0].imag) == pytest.approx(46.54, abs=0.01)
    assert wrong.margins is not None
    assert wrong.margins.gain_down == pytest.approx(0.898, abs=1e-3)
    right = analyse(model, output_lqr(model, (100.0, 0.01), 0.1).K)
    assert right.stable
    assert right.poles[0].real < -2.0


@pytest.mark.parametrize(
    "plant", [X5_9, THESIS.with_values(actuator_time_constant=0.05), X5_9.with_values(actuator_time_constant=0.01)]
)
@pytest.mark.parametrize("weights", [(1.0, 0.01), (100.0, 0.1)])
def test_the_gain_on_the_measurements_costs_least_of_all_such_gains_and_little_more_than_the_whole_state(
    plant, weights
):
    model = linearise(plant)
    Q = model.C.T @ np.diag(weights) @ model.C

    def cost(K):
        row = np.asarray(K)[None, :] @ model.C
        A = model.A - model.B @ row
        assert np.max(np.linalg.eigvals(A).real) < 0.0
        P = scipy.linalg.solve_continuous_lyapunov(A.T, -(Q + 0.1 * row.T @ row))
        follows = np.eye(model.A.shape[0], 2)
        for index, name in enumerate(model.states):
            if name.startswith("motor"):
                follows[index, index - 2] = 1.0
        return np.trace(follows.T @ P @ follows), np.trace(follows.T @ full.S @ follows)

    full = continuous_lqr(model, weights, 0.1)
    gain = output_lqr(model, weights, 0.1)
    best, bound = cost(gain.K)
    assert bound <= best < 1.1 * bound
    for step in ((1e-2, 0.0), (-1e-2, 0.0), (0.0, 1e-2), (0.0, -1e-2)):
        assert cost(gain.K * (1.0 + np.array(step)))[0] >= best * (1.0 - 1e-9)


def test_an_integral_on_the_series_elastic_plant_leaves_no_offset():
    model = linearise(X5_9)
    gain = output_lqr(with_integrals(model), (100.0, 0.01, 100.0), 0.1)
    assert gain.K.shape == (3,)
    assert np.max(gain.poles.real) < -0.5


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013, 0.03])
@pytest.mark.parametrize("name", ["thesis", "x5_9"])
def test_the_sampled_cost_is_the_continuous_one_whatever_the_delay(name, delay):
    model = linearise(load_plant(name))
    period, q, r = 0.01, (100.0, 0.5), 0.1
    Qd, Rd, Nd = sampled_cost(model, q, r, period, delay)
    sampled = discretise(model, period, delay)
    n, size = model.A.shape[0], sampled.A.shape[0]
    rng = np.random.default_rng(3)
    z, u = rng.standard_normal(size), 0.7
    # By brute force: the period in 4000 pieces, each with the torque that acts in it.
    pieces = 4000
    queue = [*z[n:], u]
    fine = discretise(model, period / pieces)
    x, total = z[:n].copy(), r * u * u * period
    rest = (sampled.pending * period - delay) % period if delay else 0.0
    switch = (period - rest) % period
    for k in range(pieces):
        acting = queue[0] if delay == 0.0 or (k + 0.5) * period / pieces < switch or switch < 1e-12 else queue[1]
        after = fine.A @ x + fine.B[:, 0] * acting
        middle = 0.5 * (x + after)
        total += (q[0] * middle[0] ** 2 + q[1] * middle[1] ** 2) * period / pieces
        x = after
    quadratic = z @ Qd @ z + 2.0 * u * float(Nd[:, 0] @ z) + Rd * u * u
    assert quadratic == pytest.approx(total, rel=1e-4)
    np.testing.assert_allclose((sampled.A @ z + sampled.B[:, 0] * u)[:n], x, rtol=1e-6, atol=1e-9)


def test_double_integrator_has_the_closed_form_gain():
    # x'' = u with Q = diag(1, 0), R = 1: K = [1, sqrt 2]; with Q = I: K = [1, sqrt 3].
    model = LinearModel(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]))
    np.testing.assert_allclose(continuous_lqr(model, (1.0, 0.0), 1.0).K, [1.0, math.sqrt(2.0)], rtol=1e-12)
    np.testing.assert_allclose(continuous_lqr(model, (1.0, 1.0), 1.0).K, [1.0, math.sqrt(3.0)], rtol=1e-12)


@given(PLANTS, WEIGHTS, st.floats(0.01, 10.0))
@settings(deadline=None, max_examples=40)
def test_second_order_gain_has_its_closed_form(plant, q, r):
    # From the Riccati equation of x'' = a x - d x' + c u: both entries of K are roots of scalar quadratics.
    model = linearise(plant)
    a, d, c = model.A[1, 0], -model.A[1, 1], model.B[1, 0]
    k0 = (a + math.sqrt(a * a + c * c * q[0] / r)) / c
    k1 = (-d + math.sqrt(d * d + 2.0 * c * k0 + c * c * q[1] / r)) / c
    np.testing.assert_allclose(continuous_lqr(model, q, r).K, [k0, k1], rtol=1e-6)


@given(PLANTS, WEIGHTS, st.floats(0.01, 10.0))
@settings(deadline=None, max_examples=30)
def test_gain_agrees_with_python_control(plant, q, r):
    model = linearise(plant)
    theirs = control.lqr(model.A, model.B, np.diag(q), np.array([[r]]))[0]
    np.testing.assert_allclose(continuous_lqr(model, q, r).K, theirs[0], rtol=1e-6)


def test_scalar_discrete_riccati_equation_has_its_closed_form():
    # Angle alone, x[k+1] = a x[k] + b u[k]: s solves s = q + a^2 s - (a b s)^2 / (r + b^2 s).
    a, b, q, r = 1.1, 0.3, 2.0, 0.5
    gain = discrete_lqr(DiscreteModel(np.array([[a]]), np.array([[b]]), 0.01, 0.0, 0), [[q]], r)
    s = gain.S[0, 0]
    p = b * b * q - r * (1 - a * a)
    assert s == pytest.approx((p + math.sqrt(p * p + 4 * b * b * q * r)) / (2 * b * b))
    assert gain.K[0] == pytest.approx(a * b * s / (r + b * b * s))


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013, 0.03])
def test_discrete_gain_solves_the_riccati_equation_of_scipy(delay):
    model = discretise(UPRIGHT, 0.01, delay)
    Q = np.zeros_like(model.A)
    Q[:2, :2] = np.diag([100.0, 0.01])
    S = scipy.linalg.solve_discrete_are(model.A, model.B, Q, np.array([[0.1]]))
    K = np.linalg.solve(0.1 + model.B.T @ S @ model.B, model.B.T @ S @ model.A)
    ours = discrete_lqr(model, (100.0, 0.01), 0.1)
    np.testing.assert_allclose(ours.K, K[0], rtol=1e-10)
    theirs = control.dlqr(model.A, model.B, Q, np.array([[0.1]]))[0]
    np.testing.assert_allclose(ours.K, theirs[0], rtol=1e-6, atol=1e-9)
    assert np.max(np.abs(ours.poles)) < 1.0


@given(PLANTS, st.floats(0.002, 0.05), st.floats(0.0, 0.12))
@settings(deadline=None, max_examples=40)
def test_sampled_model_with_delay_agrees_with_a_simulation_in_small_pieces(plant, period, delay):
    model = linearise(plant)
    sampled = discretise(model, period, delay)
    rng = np.random.default_rng(1)
    efforts = rng.uniform(-1.0, 1.0, 8)
    z = np.zeros(sampled.A.shape[0])
    z[:2] = x = np.array([0.1, -0.2])
    for effort in efforts:
        z = sampled.A @ z + sampled.B[:, 0] * effort
    # The same, exactly: the input changes at k period + delay; integrate from change to change.
    end = len(efforts) * period
    edges = sorted({0.0, end, *(t for k in range(len(efforts)) if 0.0 < (t := k * period + delay) < end)})
    for start, stop in pairwise(edges):
        index = math.floor((0.5 * (start + stop) - delay) / period)
        effort = efforts[index] if index >= 0 else 0.0
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2:] = model.A, model.B
        step = scipy.linalg.expm(block * (stop - start))
        x = step[:2, :2] @ x + step[:2, 2] * effort
    np.testing.assert_allclose(z[:2], x, rtol=1e-6, atol=1e-9)


def test_delay_compensation_restores_the_undelayed_poles():
    plain = discrete_lqr(discretise(UPRIGHT, 0.01), (100.0, 0.01), 0.1)
    delayed = discrete_lqr(discretise(UPRIGHT, 0.01, 0.02), (100.0, 0.01), 0.1)
    # A delay of whole samples adds poles at zero and changes nothing else, only the cost.
    slowest = max(delayed.poles.real)
    assert slowest == pytest.approx(max(plain.poles.real), rel=1e-6)
    assert np.sum(np.abs(delayed.poles) < 1e-4) >= 2


def test_sampled_cost_makes_the_discrete_gain_optimal_for_the_continuous_cost():
    fine = discrete_lqr(discretise(UPRIGHT, 1e-4), *_weights_with_cross(1e-4))
    continuous = continuous_lqr(UPRIGHT, (100.0, 0.01), 0.1)
    np.testing.assert_allclose(fine.K, continuous.K, rtol=2e-2)
    np.testing.assert_allclose(fine.S, continuous.S, rtol=2e-2)
    coarse = discrete_lqr(discretise(UPRIGHT, 0.05), *_weights_with_cross(0.05))
    # Sampling cannot beat the continuous optimum, from any state.
    assert np.min(np.linalg.eigvalsh(coarse.S - continuous.S)) > -1e-9


def _weights_with_cross(period):
    q, r, cross = sampled_cost(UPRIGHT, (100.0, 0.01), 0.1, period)
    return q, r, cross


def test_sampled_cost_agrees_with_quadrature():
    model = linearise(load_plant("dfki"))
    Q, R, N = sampled_cost(model, (10.0, 1.0), 2.0, 0.05)
    times = np.linspace(0.0, 0.05, 301)
    total = np.zeros((3, 3))
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2:] = model.A, model.B
    values = []
    for t in times:
        step = scipy.linalg.expm(block * t)
        values.append(step.T @ np.diag([10.0, 1.0, 2.0]) @ step)
    total = scipy.integrate.trapezoid(values, times, axis=0)
    np.testing.assert_allclose(np.block([[Q, N], [N.T, R]]), total, rtol=1e-4, atol=1e-7)


def test_integral_action_leaves_no_offset_and_needs_a_weight():
    gain = output_lqr(with_integrals(UPRIGHT), (100.0, 0.01, 50.0), 0.1)
    assert np.max(gain.poles.real) < 0.0
    assert gain.K[2] == pytest.approx(math.sqrt(50.0 / 0.1), rel=1e-6)
    with pytest.raises(DesignError, match=r"no stabilising gain for q = \[100.0, 0.01, 0.0\]"):
        output_lqr(with_integrals(UPRIGHT), (100.0, 0.01, 0.0), 0.1)


@pytest.mark.parametrize(
    ("q", "r", "text"),
    [
        ((1.0, -1.0), 0.1, r"q is \[1\.0, -1\.0\], with the eigenvalue -1; expected no negative weight"),
        ((1.0, math.nan), 0.1, "expected finite weights"),
        ((1.0, 1.0, 1.0), 0.1, r"q has the shape \(3,\); expected \(2,\)"),
        (((1.0, 2.0), (0.0, 1.0)), 0.1, "expected a symmetric matrix"),
        ((1.0, 1.0), 0.0, r"r is 0\.0 1/\(N m\)\^2; expected a finite weight > 0"),
        ((1.0, 1.0), math.inf, "r is inf"),
    ],
)
def test_a_bad_weight_is_refused_with_its_reason(q, r, text):
    with pytest.raises(DesignError, match=text):
        continuous_lqr(UPRIGHT, q, r)


def test_a_mode_that_no_torque_reaches_is_refused():
    with pytest.raises(DesignError, match=r"mode at 0\.142471 is not controllable: no torque reaches it"):
        require_controllable(UPRIGHT.A, np.zeros((2, 1)))
    unreachable = LinearModel(np.diag([1.0, -2.0]), np.array([[0.0], [1.0]]))
    with pytest.raises(DesignError, match="mode at 1 is not controllable"):
        continuous_lqr(unreachable, (1.0, 1.0), 1.0)


def test_a_mode_that_no_measurement_shows_is_refused():
    integrator = np.array([[1.0, 0.01], [0.0, 1.0]])
    with pytest.raises(DesignError, match="mode at 1 is not observable: no measurement shows it"):
        require_observable(integrator, np.array([[0.0, 1.0]]))
    with pytest.raises(DesignError, match="not observable"):
        kalman_gain(integrator, np.array([[0.0, 1.0]]), np.eye(2), [[1.0]])
    with pytest.raises(DesignError, match="expected every variance > 0"):
        kalman_gain(integrator, np.array([[1.0, 0.0]]), np.eye(2), [[0.0]])


def test_kalman_gain_agrees_with_python_control():
    model = discretise(UPRIGHT, 0.01)
    ours = kalman_gain(model.A, np.array([[1.0, 0.0]]), model.B @ model.B.T, [[1e-6]])
    _, P, _ = control.dlqe(model.A, model.B, np.array([[1.0, 0.0]]), np.eye(1), [[1e-6]])
    np.testing.assert_allclose(ours.P, P, rtol=1e-6, atol=1e-12)


@given(PLANTS, WEIGHTS, st.floats(0.01, 10.0))
@settings(deadline=None, max_examples=25)
def test_every_continuous_lqr_has_the_guaranteed_margins(plant, q, r):
    # Gain margin (1/2, inf), phase margin 60 degrees, modulus margin 1: Safonov and Athans, IEEE TAC 22(2), 1977.
    model = linearise(plant)
    margins = loop_margins(model, continuous_lqr(model, q, r).K)
    assert margins.gain_up == math.inf
    assert margins.gain_down <= 0.5 + 1e-9
    assert margins.phase >= math.radians(60.0) - 1e-6
    assert margins.modulus >= 1.0 - 1e-6


def test_the_gain_margin_is_where_the_loop_becomes_unstable():
    K = continuous_lqr(UPRIGHT, (100.0, 0.01), 0.1).K
    down = loop_margins(UPRIGHT, K).gain_down
    assert analyse(UPRIGHT, 1.001 * down * K).time_constant < math.inf
    assert analyse(UPRIGHT, 0.999 * down * K).time_constant == math.inf


@pytest.mark.parametrize("name", ["thesis", "dfki"])
def test_the_delay_margin_is_where_the_loop_becomes_unstable(name):
    model = linearise(load_plant(name))
    K = continuous_lqr(model, (10.0, 1.0), 1.0).K
    delay = loop_margins(model, K).delay
    # Sampled thirty times within the delay, the loop is close to continuous; half a period is a delay of its own.
    period = delay / 30.0
    assert delayed_spectral_radius(model, K, period, 0.97 * delay - 0.5 * period) < 1.0
    assert delayed_spectral_radius(model, K, period, 1.03 * delay - 0.5 * period) > 1.0


@pytest.mark.parametrize("name", ["thesis", "dfki"])
def test_the_largest_period_is_where_the_held_loop_becomes_unstable(name):
    model = linearise(load_plant(name))
    K = continuous_lqr(model, (100.0, 0.01), 0.1).K
    period = largest_stable_period(model, K)
    assert delayed_spectral_radius(model, K, 0.999 * period) < 1.0
    assert delayed_spectral_radius(model, K, 1.001 * period) > 1.0


def test_an_unstable_gain_has_no_stable_period():
    assert largest_stable_period(UPRIGHT, [0.1, 0.0]) == 0.0


@pytest.mark.parametrize(
    ("period", "delay"), [(0.0, 0.0), (-1.0, 0.0), (math.nan, 0.0), (0.01, -1.0), (0.01, math.inf)]
)
def test_a_bad_period_or_delay_is_refused(period, delay):
    with pytest.raises(DesignError, match=r"(period|delay) is .* s; expected a finite value"):
        discretise(UPRIGHT, period, delay)
