"""The series-elastic plant: back EMF, sticking motor, spring, and that it is what the thesis's model stands for."""

from __future__ import annotations

import math

import pytest

from pendulum_msgs_py.dynamics.series_elastic import shorted_winding_damping, winding_resistance_at
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_sim.stepping.series_elastic import SeriesElasticPlant
from pendulum_sim.stepping.servo import PositionServo


def test_back_emf_alone_makes_the_damping_of_the_thesis() -> None:
    drive = load_plant("x5_9").drivetrain
    assert drive is not None
    resistance = winding_resistance_at(22.0, drive.winding_resistance, 0.004)
    damping = shorted_winding_damping(drive.torque_constant, drive.back_emf_constant, drive.gear_ratio, resistance)
    assert damping == pytest.approx(11.77, abs=0.01)


def test_a_motor_whose_friction_carries_the_weight_does_not_creep_by_a_single_bit() -> None:
    # 1.678 sin(0.2) = 0.333 N m, below the 0.39 N m that the motor's friction holds.
    plant = SeriesElasticPlant(load_plant("x5_9"), 2e-3)
    plant.reset(0.2)
    motor = plant.q_m
    for _ in range(2000):
        plant.step(0.0)
        assert plant.q_m == motor
        assert plant.v_m == 0.0
    assert abs(plant.theta - 0.2) < 1e-9


def test_a_weight_that_friction_cannot_carry_sinks_until_it_can() -> None:
    plant = SeriesElasticPlant(load_plant("x5_9"), 2e-3)
    plant.reset(0.6)
    angles = [plant.step(0.0).theta for _ in range(12500)]
    assert 1.678 * math.sin(angles[-1]) == pytest.approx(0.39, abs=0.02)
    assert abs(plant.v_m) < 2e-3


def test_the_measured_effort_at_rest_is_the_weight_that_the_spring_carries() -> None:
    parameters = load_plant("x5_9")
    plant = make_pendulum(parameters, 2e-3)
    state = plant.reset(0.1)
    assert state.effort == pytest.approx(parameters.gravity * math.sin(0.1), rel=1e-12)


def test_the_result_does_not_depend_on_the_step_once_it_is_small() -> None:
    def run(substeps: int) -> float:
        plant = SeriesElasticPlant(load_plant("x5_9"), 2e-3, substeps=substeps)
        plant.reset(1.0)
        for k in range(500):
            plant.step(3.0 * math.sin(0.02 * k))
        return plant.theta

    coarse, fine, finest = run(8), run(32), run(128)
    assert abs(coarse - finest) < 2e-3
    assert abs(fine - finest) < 0.5 * abs(coarse - finest)


def test_without_losses_it_moves_like_the_rigid_plant_with_the_same_damping() -> None:
    from dataclasses import replace

    parameters = load_plant("x5_9")
    assert parameters.drivetrain is not None
    drive = replace(
        parameters.drivetrain,
        motor_coulomb_friction=0.0,
        motor_static_friction=0.0,
        motor_damping=0.0,
        hysteresis_torque=0.0,
        efficiency=1.0,
        stiffness=1000.0,
        winding_temperature=20.0,
    )
    elastic = make_pendulum(parameters.with_values(drivetrain=drive), 2e-3)
    damping = parameters.damping + shorted_winding_damping(
        drive.torque_constant, drive.back_emf_constant, drive.gear_ratio, drive.winding_resistance
    )
    rigid = RigidPlant(
        parameters.with_values(drivetrain=None, damping=damping, inertia=parameters.inertia + drive.reflected_inertia),
        2e-3,
    )
    elastic.reset(1.5)
    rigid.reset(1.5)
    for k in range(1500):
        effort = 2.0 * math.sin(0.01 * k)
        soft, stiff = elastic.step(effort), rigid.step(effort)
        assert soft.theta == pytest.approx(stiff.theta, abs=0.01)


@pytest.mark.parametrize(("name", "bound"), [("thesis", 2e-3), ("x5_9", 8e-3)])
def test_the_servo_follows_a_ramp_to_upright_and_back_and_reports_a_bounded_effort(name: str, bound: float) -> None:
    parameters = load_plant(name)
    plant = make_pendulum(parameters, 2e-3)
    servo = PositionServo(parameters, 2e-3)
    state = plant.reset(0.0)
    for k in range(9000):
        t = k * 2e-3
        position = min(0.2 * t, math.pi) if t < 17.0 else math.pi
        velocity = 0.2 if 0.2 * t < math.pi else 0.0
        effort = servo.effort(state.theta, state.theta_dot, position, velocity)
        assert abs(effort) <= parameters.effort_limit
        state = plant.step(effort)
        assert abs(state.theta - position) < bound
    assert abs(effort) < 0.5


def test_an_integrator_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ParameterError, match="method is 'rk4'; expected semi_implicit or auto"):
        make_pendulum(load_plant("x5_9"), 1e-3, method="rk4")
    with pytest.raises(ParameterError, match="is series elastic; expected a rigid one"):
        RigidPlant(load_plant("x5_9"), 1e-3)
