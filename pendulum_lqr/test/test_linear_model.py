"""The linearisation against finite differences, fixed points against the equation."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.linear.model import (
    LinearModel,
    equilibrium_effort,
    linearise,
    state_derivative,
)
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import fixed_points, overdamped_velocity, torque_gain
from pendulum_msgs_py.plants.plant_parameters import load_plant, pendulum_plant
from pendulum_sim.stepping.plants import make_pendulum

PLANTS = st.builds(
    pendulum_plant,
    inertia=st.floats(1e-3, 10.0),
    damping=st.floats(0.0, 20.0),
    gravity=st.floats(0.0, 20.0),
    torque_offset=st.floats(-1.0, 1.0),
    angle_offset=st.floats(-0.2, 0.2),
)


@given(PLANTS, st.floats(-7.0, 7.0))
@settings(deadline=None)
def test_linearisation_agrees_with_finite_differences_about_any_fixed_point(plant, theta):
    model = linearise(plant, theta)
    h = 1e-5
    for column, (a, b) in enumerate((((h, 0.0), (-h, 0.0)), ((0.0, h), (0.0, -h)))):
        forward = np.array(state_derivative(plant, theta + a[0], a[1], model.effort))
        backward = np.array(state_derivative(plant, theta + b[0], b[1], model.effort))
        scale = 1.0 + float(np.abs(model.A).max())
        np.testing.assert_allclose((forward - backward) / (2 * h), model.A[:, column], atol=1e-6 * scale)
    pushed = np.array(state_derivative(plant, theta, 0.0, model.effort + 1.0))
    rest = np.array(state_derivative(plant, theta, 0.0, model.effort))
    np.testing.assert_allclose(pushed - rest, model.B[:, 0], rtol=1e-9, atol=1e-9)


@given(PLANTS, st.floats(-7.0, 7.0))
@settings(deadline=None)
def test_the_holding_torque_leaves_no_acceleration(plant, theta):
    acceleration = state_derivative(plant, theta, 0.0, equilibrium_effort(plant, theta))[1]
    assert abs(acceleration) * plant.inertia < 1e-12


def test_the_thesis_plant_has_the_matrices_of_the_thesis():
    model = linearise(load_plant("thesis"))
    np.testing.assert_allclose(model.A, [[0.0, 1.0], [30.51, -214.0]], atol=0.005)
    np.testing.assert_allclose(model.B, [[0.0], [18.18]], atol=0.005)
    np.testing.assert_allclose(model.poles, [0.142471, -214.142471], atol=5e-7)
    assert model.effort == 0.0


@given(st.floats(-0.99, 0.99))
@settings(deadline=None)
def test_a_constant_torque_has_one_stable_and_one_unstable_fixed_point(share):
    plant = load_plant("thesis")
    points = fixed_points(plant, share * plant.gravity)
    assert [point.stable for point in points] == [True, False]
    for point in points:
        assert abs(plant.gravity * math.sin(point.theta) - point.effort) < 1e-12
        assert (linearise(plant, point.theta).poles[0].real < 0.0) == point.stable


def test_a_torque_beyond_gravity_has_no_fixed_point_and_one_at_the_tip_has_one():
    plant = load_plant("thesis")
    assert fixed_points(plant, 1.01 * plant.gravity) == ()
    assert len(fixed_points(plant, plant.gravity)) == 1
    assert fixed_points(plant.with_values(gravity=0.0), 0.0) == ()


def test_overdamped_velocity_is_zero_at_the_fixed_points_and_needs_damping():
    plant = load_plant("thesis")
    angles = np.array([point.theta for point in fixed_points(plant, 0.5)])
    np.testing.assert_allclose(overdamped_velocity(plant, angles, 0.5), 0.0, atol=1e-15)
    with pytest.raises(ParameterError, match=r"damping is 0\.0 N m s/rad; expected > 0"):
        overdamped_velocity(plant.with_values(damping=0.0), angles)


def test_an_angle_that_is_not_finite_is_refused():
    with pytest.raises(ParameterError, match="theta of the fixed point is nan rad; expected a finite angle"):
        linearise(load_plant("thesis"), math.nan)


def _without_dry_friction(plant):
    if plant.drivetrain is None:
        return plant.with_values(coulomb_friction=0.0, static_friction=0.0)
    smooth = replace(plant.drivetrain, motor_coulomb_friction=0.0, motor_static_friction=0.0, hysteresis_torque=0.0)
    return plant.with_values(drivetrain=smooth)


SIMULATED = {
    "thesis": {},
    "dfki": {},
    "x5_9": {},
    "thesis, lag and delay": {"actuator_time_constant": 0.02, "transport_delay": 0.007},
    "x5_9, lag, delay and offsets": {
        "actuator_time_constant": 0.02,
        "transport_delay": 0.004,
        "angle_offset": 0.3,
        "torque_offset": 0.2,
    },
}


@pytest.mark.parametrize("theta", [UPRIGHT, UPRIGHT - 0.5, 0.3])
@pytest.mark.parametrize("case", SIMULATED)
def test_the_linear_model_moves_as_the_simulated_plant_does_under_a_small_torque_on_command_and_link(case, theta):
    plant = _without_dry_friction(load_plant(case.split(",")[0]).with_values(**SIMULATED[case]))
    model = linearise(plant, theta)
    period, steps = 0.002, 100
    torque = 1e-4 * (1.0 + np.sin(0.1 * np.arange(steps)))
    push = 5e-5

    def simulate(share):
        simulated = make_pendulum(plant, period, substeps=20)
        simulated.reset(theta)
        states = [simulated.step(model.effort + share * u, share * push) for u in torque]
        return np.array([(state.theta, state.theta_dot) for state in states])

    # The difference of two runs: what the plant does by itself, as long as its actuator has no torque yet, falls out.
    moved = simulate(1.0) - simulate(0.0)
    sampled = discretise(model, period)
    by_push = discretise(LinearModel(model.A, model.E, states=model.states), period).B[:, 0] * push
    z = np.zeros(sampled.A.shape[0])
    expected = []
    for u in torque:
        z = sampled.A @ z + sampled.B[:, 0] * u
        z[: by_push.size] += by_push
        expected.append(z[:2])
    for column, size in enumerate(np.max(np.abs(moved), axis=0)):
        np.testing.assert_allclose(moved[:, column], np.array(expected)[:, column], rtol=0.0, atol=0.01 * size)


def test_the_x5_9_linearised_is_a_slow_pole_behind_the_motor_and_not_a_fast_free_link():
    model = linearise(load_plant("x5_9"))
    assert model.states == ("theta", "theta_dot", "motor_angle", "motor_velocity")
    # Closed form of the slow pole: gravity against all the damping there is, back EMF and bearings, with the inertias.
    assert model.poles[0].real == pytest.approx(0.129, abs=5e-4)
    assert model.poles[-1].real == pytest.approx(-63.67, abs=0.01)


def test_a_series_elastic_actuator_holds_with_less_than_the_weight_because_it_answers_with_more():
    plant = load_plant("x5_9")
    assert torque_gain(plant) == pytest.approx(1.0 / (0.65 * 1.008), rel=1e-12)
    simulated = make_pendulum(_without_dry_friction(plant), 0.002)
    simulated.reset(2.0)
    for _ in range(500):
        state = simulated.step(equilibrium_effort(plant, 2.0))
    assert state.theta == pytest.approx(2.0, abs=1e-4)


@settings(deadline=None, max_examples=30)
@given(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(-0.8, 0.8), st.sampled_from(["thesis", "dfki", "x5_9"]))
def test_the_simulated_plant_rests_at_its_fixed_points_whatever_its_offsets(angle, torque, effort, name):
    plant = _without_dry_friction(load_plant(name)).with_values(angle_offset=angle, torque_offset=torque)
    points = fixed_points(plant, effort)
    assert len(points) == 2
    for point in points:
        assert equilibrium_effort(plant, point.theta) == pytest.approx(effort, abs=1e-9)
        assert (linearise(plant, point.theta).poles[0].real < 0.0) == point.stable
        simulated = make_pendulum(plant, 0.002)
        simulated.reset(point.theta)
        for _ in range(5):
            state = simulated.step(effort)
        # The spring starts without the offset, and gives way by no more than that.
        slack = abs(torque) / plant.drivetrain.stiffness if plant.drivetrain else 0.0
        assert state.theta == pytest.approx(point.theta, abs=slack + 1e-9)
