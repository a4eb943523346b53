"""Velocity estimators on signals whose velocity is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.velocity import VELOCITY_ESTIMATORS, KalmanVelocity, SavitzkyGolay
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.stepping.plants import make_pendulum

THESIS = load_plant("thesis")
DFKI = load_plant("dfki")


@pytest.mark.parametrize("name", VELOCITY_ESTIMATORS)
def test_a_steady_turn_across_the_wrap_gives_its_velocity(name):
    if name == "kalman":
        pytest.skip("its model knows gravity, and a steady turn is no motion of a free pendulum")
    estimator = VELOCITY_ESTIMATORS[name](THESIS, 0.01)
    estimates = [estimator.update(0.01 * k, wrap(0.02 * k), 2.0, 0.0) for k in range(400)]
    np.testing.assert_allclose(estimates[50:], 2.0, rtol=1e-6)


@pytest.mark.parametrize("name", VELOCITY_ESTIMATORS)
def test_no_estimator_looks_at_the_measured_velocity_once_it_runs(name):
    estimator = VELOCITY_ESTIMATORS[name](THESIS, 0.01)
    for k in range(100):
        estimate = estimator.update(0.01 * k, 0.1, 0.0 if k == 0 else 77.0, -THESIS.gravity * math.sin(0.1))
    assert abs(estimate) < 0.05


def test_kalman_follows_a_swinging_pendulum_better_than_a_difference():
    plant = DFKI.with_values(coulomb_friction=0.0, static_friction=0.0)
    rng = np.random.default_rng(0)
    errors = {}
    for name, estimator in {
        "kalman": KalmanVelocity(plant, 0.01, position_noise=2e-3, torque_noise=0.1),
        "filtered_difference": VELOCITY_ESTIMATORS["filtered_difference"](plant, 0.01),
    }.items():
        simulated = make_pendulum(plant, 0.01)
        state = simulated.reset(0.5)
        squares = []
        for k in range(500):
            effort = 0.5 * math.sin(0.05 * k)
            measured = wrap(state.theta - math.pi + rng.normal(0.0, 2e-3))
            estimate = estimator.update(0.01 * k, measured, state.theta_dot, effort if k else 0.0)
            squares.append((estimate - state.theta_dot) ** 2)
            last = effort
            state = simulated.step(last)
        errors[name] = math.sqrt(np.mean(squares[50:]))
    assert errors["kalman"] < 0.5 * errors["filtered_difference"]


def test_savitzky_golay_is_exact_for_a_parabola_and_starts_anew_after_a_hole():
    estimator = SavitzkyGolay(0.01)
    for k in range(20):
        t = 0.01 * k
        estimate = estimator.update(t, 0.3 * t * t + 0.1 * t, 9.0, 0.0)
    assert estimate == pytest.approx(0.6 * t + 0.1, rel=1e-9)
    assert estimator.update(t + 0.5, 0.0, 9.0, 0.0) == 9.0


def test_a_reset_forgets():
    for name in VELOCITY_ESTIMATORS:
        estimator = VELOCITY_ESTIMATORS[name](THESIS, 0.01)
        first = [estimator.update(0.01 * k, 0.01 * k, 1.0, 0.0) for k in range(20)]
        estimator.reset()
        assert [estimator.update(0.01 * k, 0.01 * k, 1.0, 0.0) for k in range(20)] == first


@pytest.mark.parametrize("name", ["measured", *VELOCITY_ESTIMATORS])
def test_lqr_balances_on_every_estimator(name, simulate):
    controller = make_controller("lqr", THESIS, 0.01, {"velocity": name})
    run = simulate(THESIS, controller, theta=math.pi + 0.2)
    assert abs(run.angle[-1]) < 1e-3


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("thesis", {}),
        ("x5_9", {}),
        ("dfki", {"angle_offset": 0.4, "torque_offset": 0.3}),
        ("dfki", {"transport_delay": 0.035, "actuator_time_constant": 0.05}),
        ("x5_9", {"transport_delay": 0.013}),
    ],
)
def test_kalman_gives_the_velocity_of_every_plant_in_a_free_fall_under_torque(name, changes):
    plant = load_plant(name).with_values(coulomb_friction=0.0, static_friction=0.0, **changes)
    if plant.drivetrain is not None:
        smooth = {"motor_coulomb_friction": 0.0, "motor_static_friction": 0.0, "hysteresis_torque": 0.0}
        plant = plant.with_values(drivetrain=replace(plant.drivetrain, **smooth))
    # Hardly any torque but the one that it was told of: what it then says comes from its model.
    estimator = KalmanVelocity(plant, 0.01, position_noise=1e-2, torque_noise=1e-3)
    simulated = make_pendulum(plant, 0.01)
    state = simulated.reset(2.5)
    effort, errors, speeds = 0.0, [], []
    for k in range(300):
        estimate = estimator.update(0.01 * k, wrap(state.theta - math.pi), state.theta_dot, effort)
        errors.append(estimate - state.theta_dot)
        speeds.append(state.theta_dot)
        effort = 1.2 * math.sin(0.05 * k)
        state = simulated.step(effort)
    assert np.max(np.abs(errors)) < 0.03 * np.max(np.abs(speeds))


def test_an_unknown_estimator_is_refused():
    with pytest.raises(ParameterError, match="velocity is 'magic'; expected one of measured, filtered_difference"):
        make_controller("lqr", THESIS, 0.01, {"velocity": "magic"})
