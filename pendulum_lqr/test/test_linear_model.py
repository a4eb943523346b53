"""The linearisation against finite differences, fixed points against the equation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.model import (
    equilibrium_effort,
    fixed_points,
    linearise,
    overdamped_velocity,
    state_derivative,
)
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant

PLANTS = st.builds(
    PlantParameters,
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
