"""Designs for plants in volts: the linear model, gains in V/rad, and controllers of the plant behind its motors."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import VoltageOutput, controller_parameters, make_controller
from pendulum_lqr.controller_interface.interface import unwrapped
from pendulum_lqr.design_command.design_cli import main
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import holding_effort, linearise
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.joint_parameters import Actuator, Motor
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

QUBE = load_mechanism("qube_servo")
FAST = QUBE.with_values({"arm.inductance": 0.0})
PERIOD = 0.002


def _double() -> PlantParameters:
    plant = load_mechanism("double_pendulum_frictionless")
    motors = (Motor(2.0, 0.05, 12.0, gear_ratio=14.0), Motor(3.0, 0.04, 12.0, gear_ratio=9.0))
    joints = zip(plant.joints, motors, strict=True)
    driven = tuple(replace(own, actuator=Actuator(1.0, motor=motor)) for own, motor in joints)
    return PlantParameters(plant.mechanism, plant.values, driven, "double_in_volts")


DOUBLE = _double()


def _slope(plant: PlantParameters, index: int, step: float) -> np.ndarray:
    """Return the change of the rates per state or voltage ``index``, by differences of the windings' own equations."""
    n, goal = len(plant.joints), plant.coordinates.goal
    own = (*plant.values, *(joint.damping for joint in plant.joints))

    def rates(x: np.ndarray) -> np.ndarray:
        q, v, effort = tuple(x[:n] + goal), tuple(x[n : 2 * n]), [0.0] * n
        for joint, actuator, u in zip(plant.coordinates.driven, plant.actuators, x[2 * n :], strict=True):
            motor = actuator.motor
            assert motor is not None
            turns = motor.gear_ratio
            effort[joint] = (
                turns * motor.torque_constant * (u - motor.torque_constant * turns * v[joint]) / motor.resistance
            )
        return np.array([*v, *plant.mechanism.forward(q, v, tuple(effort), own)])

    x = np.zeros(2 * n + len(plant.actuators))
    x[index] = step
    found: np.ndarray = (rates(x) - rates(-x)) / (2.0 * step)
    return found


@pytest.mark.parametrize("plant", [FAST, DOUBLE], ids=lambda plant: plant.name)
def test_the_model_is_the_slope_of_the_windings_equations(plant: PlantParameters) -> None:
    model, size = linearise(plant), 2 * len(plant.joints)
    found = np.stack([_slope(plant, index, 1e-5) for index in range(size + len(plant.actuators))], axis=1)
    np.testing.assert_allclose(model.A, found[:, :size], atol=2e-4)
    np.testing.assert_allclose(model.B, found[:, size:], rtol=1e-6, atol=1e-6)


def test_an_inductance_is_a_lag_of_the_voltage() -> None:
    slow = linearise(QUBE)
    assert slow.states[-1] == "arm_effort"
    assert slow.A[-1, -1] == pytest.approx(-8.4 / 0.00116)
    assert slow.B[-1, 0] == pytest.approx(0.005 * 8.4 / 0.00116)
    assert not slow.B[:-1].any()


@pytest.mark.parametrize("plant", [FAST, QUBE], ids=("quasi-static", "with inductance"))
def test_a_gain_in_volts_is_the_gain_in_torque_over_the_torque_per_volt(plant: PlantParameters) -> None:
    q, r = plant.weights
    volts = output_lqr(linearise(plant), q, r).K
    torque = output_lqr(linearise(plant.torque_plant), q, plant.torque_plant.weights[1]).K
    np.testing.assert_allclose(0.005 * volts, torque, rtol=1e-6)


def test_what_holds_a_weight_is_a_voltage() -> None:
    away = (*DOUBLE.coordinates.goal[:1], 0.7)
    volts = holding_effort(DOUBLE, away)
    np.testing.assert_allclose(np.multiply(volts, DOUBLE.gains), holding_effort(DOUBLE.torque_plant, away), rtol=1e-12)
    at_rest = DOUBLE.acceleration(away, (0.0, 0.0), DOUBLE.stall_efforts(volts))
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-9)


def _run(plant: PlantParameters, name: str, start: tuple[float, ...], time: float) -> tuple[np.ndarray, float]:
    """Return the deviation at the end and the largest voltage of a sampled loop on the quasi-static equation."""
    controller = make_controller(name, plant, PERIOD)
    along, n = along_functions(len(plant.joints)), len(plant.joints)
    q, v, largest = start, (0.0,) * n, 0.0
    for k in range(round(time / PERIOD)):
        volts = controller.efforts(k * PERIOD, q, v)
        largest = max(largest, *map(abs, volts))
        tau = plant.coordinates.spread(plant.stall_efforts(volts))
        q, v = rk4_joints(plant.mechanism.forward, along, q, v, tau, tau, tau, PERIOD, plant.packed)
    return np.array([*plant.coordinates.deviation(q), *v]), largest


@pytest.mark.parametrize("name", ["lqr", "lqi", "lqg", "discrete_lqr", "mpc"])
@pytest.mark.parametrize("plant", [QUBE, DOUBLE], ids=lambda plant: plant.name)
def test_linear_controllers_answer_in_volts_and_settle(plant: PlantParameters, name: str) -> None:
    start = tuple(goal + off for goal, off in zip(plant.coordinates.goal, (0.0, 0.02), strict=True))
    end, largest = _run(plant, name, start, 4.0)
    assert np.abs(end).max() < 5e-3
    # Volts: their sizes are far from those of the torques.
    assert 0.3 < largest <= max(plant.command_limits)
    assert make_controller(name, plant, PERIOD).effort_limits == plant.command_limits


def test_a_swing_up_of_the_plant_behind_the_motor_is_given_as_volts() -> None:
    controller = make_controller("energy_swing_up", FAST, PERIOD, {"effort_limit": 6.0})
    assert isinstance(controller, VoltageOutput)
    assert controller.effort_limits == pytest.approx((6.0,))
    assert unwrapped(controller).effort_limits == pytest.approx((0.03,))
    specs = {spec.name: spec.unit for spec in controller_parameters("energy_swing_up", FAST)}
    assert specs["effort_limit"] == "V"
    end, largest = _run(FAST, "energy_swing_up", (0.0, 0.0), 10.0)
    assert np.abs(end[1:]).max() < 0.05
    assert 1.0 < largest <= 10.0


def test_the_design_command_says_that_its_gains_are_in_volts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--preset", "qube_servo"]) == 0
    said = capsys.readouterr().out
    assert "u* = 0 V" in said
    assert "K in V per unit of its state: the motor of arm gives 0.005 N m/V, damps by 0.00021 N m s/rad" in said
    assert math.isclose(float(said.split("K = [")[1].split(",")[0]), -19.533, abs_tol=1e-3)


def test_a_playback_is_in_the_unit_of_its_plant_and_refuses_a_file_in_the_other(tmp_path: Path) -> None:
    file = tmp_path / "input.csv"
    rest = (0.0, 0.0)
    for header, plant, other in (("time,voltage", QUBE, "furuta"), ("time,effort", load_mechanism("furuta"), "qube")):
        file.write_text(f"{header}\n0.0,0.05\n1.0,0.0\n")
        assert make_controller("playback", plant, PERIOD, {"file": str(file)}).efforts(0.5, rest, rest) == (0.05,)
        with pytest.raises(DataError, match=f"plant '{other}.* is driven in (V|N m); expected a header with"):
            make_controller("playback", QUBE if other == "qube" else load_mechanism(other), PERIOD, {"file": str(file)})
