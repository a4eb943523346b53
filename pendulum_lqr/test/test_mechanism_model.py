"""Linear models and LQR of plants of several joints."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scipy.integrate

from pendulum_lqr.design_command.design_cli import main
from pendulum_lqr.linear.analysis import analyse
from pendulum_lqr.linear.design import DesignError, continuous_lqr
from pendulum_lqr.linear.mechanism_model import holding_effort, linearise_mechanism, mechanism_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism
from pendulum_msgs_py.plants.plant_parameters import load_plant
from tests.joint_plants import without_friction

_PLANTS = ("cart_pole", "acrobot", "pendubot", "double_pendulum", "furuta")


@pytest.mark.parametrize("name", ["thesis", "dfki"])
def test_the_model_of_one_joint_is_that_of_the_one_joint_design_bit_for_bit(name: str) -> None:
    one, many = linearise(load_plant(name)), linearise_mechanism(load_mechanism(name))
    assert np.array_equal(one.A, many.A)
    assert np.array_equal(one.B, many.B)
    assert np.array_equal(one.E, many.E)
    assert many.position == (one.theta,)
    assert many.efforts == (one.effort,) == (0.0,)
    gain = mechanism_lqr(many, (100.0, 0.01), 0.1)
    assert np.array_equal(gain.K[0], continuous_lqr(one, (100.0, 0.01), 0.1).K)


@pytest.mark.parametrize("name", _PLANTS)
def test_the_linear_model_has_the_slopes_of_the_equations(name: str) -> None:
    plant = load_mechanism(name)
    model = linearise_mechanism(plant)
    n, h = len(plant.joints), 1e-6
    assert model.A.shape == (2 * n, 2 * n)
    assert model.B.shape == (2 * n, len(plant.coordinates.driven))

    def flow(x: np.ndarray) -> np.ndarray:
        q, v, u = tuple(x[:n]), tuple(x[n : 2 * n]), tuple(x[2 * n :])
        return np.array([*v, *plant.acceleration(q, v, plant.coordinates.spread(u))])

    at = np.array([*model.position, *(0.0,) * n, *model.efforts])
    for j, column in enumerate(np.hstack([model.A, model.B]).T):
        step = h * np.eye(at.size)[j]
        np.testing.assert_allclose((flow(at + step) - flow(at - step)) / (2 * h), column, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", _PLANTS)
def test_the_lqr_brings_the_whole_plant_back_to_upright(name: str) -> None:
    plant = without_friction(load_mechanism(name))
    model = linearise_mechanism(plant)
    gain = mechanism_lqr(model, *plant.mechanism.weights)
    assert gain.K.shape == (len(plant.coordinates.driven), 2 * len(plant.joints))
    n = len(plant.joints)

    def flow(_t: float, x: np.ndarray) -> list[float]:
        deviation = np.array([*plant.coordinates.deviation(tuple(x[:n])), *x[n:]])
        u = tuple(np.clip(-gain.K @ deviation, *(np.array(plant.effort_limits) * sign for sign in (-1, 1))))
        return [*x[n:], *plant.acceleration(tuple(x[:n]), tuple(x[n:]), plant.coordinates.spread(u))]

    start = np.array([*plant.coordinates.goal, *(0.0,) * n])
    start[n - 1] += 0.02
    end = scipy.integrate.solve_ivp(flow, (0.0, -12.0 / gain.poles[0].real), start, rtol=1e-8, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(end, [*plant.coordinates.goal, *(0.0,) * n], atol=1e-3)


def test_sampled_designs_and_margins_take_a_model_of_several_joints() -> None:
    model = linearise_mechanism(load_mechanism("cart_pole"))
    q, r = load_mechanism("cart_pole").mechanism.weights
    cost, cost_r, cross = sampled_cost(model, q, r, 1e-3)
    sampled = discrete_lqr(discretise(model, 1e-3), cost, cost_r, cross)
    continuous = mechanism_lqr(model, q, r)
    np.testing.assert_allclose(sampled.K, continuous.K[0], rtol=0.02)
    report = analyse(model, continuous.K[0])
    assert report.margins is not None
    assert report.margins.modulus == pytest.approx(1.0, abs=1e-6)
    assert report.largest_period is not None
    assert 0.0 < report.largest_period < 1.0


def test_a_position_is_held_by_driven_joints_and_refused_where_a_passive_one_falls() -> None:
    both = load_mechanism("double_pendulum")
    q = (2.0, 0.5)
    efforts = holding_effort(both, q)
    assert both.acceleration(q, (0.0, 0.0), efforts) == pytest.approx((0.0, 0.0), abs=1e-9)
    with pytest.raises(ParameterError, match=r"shoulder is passive and would fall from 2 rad with -?\d"):
        linearise_mechanism(load_mechanism("acrobot"), q)
    with pytest.raises(ParameterError, match=r"position is \[1.0\]; expected 2 finite numbers, for shoulder \[rad\]"):
        linearise_mechanism(both, (1.0,))


def test_weights_of_another_shape_are_refused() -> None:
    model = linearise_mechanism(load_mechanism("double_pendulum"))
    with pytest.raises(DesignError, match=r"q has the shape \(2,\); expected \(4,\)"):
        mechanism_lqr(model, (1.0, 1.0), 1.0)
    for r in (0.0, (1.0, -1.0), (1.0, 1.0, 1.0)):
        with pytest.raises(DesignError, match=r"expected one finite weight > 0, or 2"):
            mechanism_lqr(model, (1.0,) * 4, r)


def test_an_arm_that_gravity_does_not_move_past_upright_is_refused_where_no_torque_reaches_it() -> None:
    flat = load_mechanism("acrobot_frictionless").with_values({"gravity": 0.0})
    with pytest.raises(DesignError, match="is not controllable"):
        mechanism_lqr(linearise_mechanism(flat), (1.0,) * 4, 1.0)


def test_the_command_prints_gains_of_several_joints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--preset", "acrobot", "--q", "10,10,1,1", "--r", "1", "--r", "10", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    gain = mechanism_lqr(linearise_mechanism(load_mechanism("acrobot")), (10.0, 10.0, 1.0, 1.0), 10.0)
    assert document["rows"][1]["K"] == gain.K.tolist()
    assert document["driven"] == ["elbow"]
    assert main(["--preset", "double_pendulum"]) == 0
    assert "states shoulder, elbow, shoulder_dot, elbow_dot" in capsys.readouterr().out
    assert main(["--preset", "acrobot", "--q", "1,1"]) == 2
    assert "expected 4 numbers, for shoulder, elbow, shoulder_dot, elbow_dot" in capsys.readouterr().err
    assert main(["--preset", "acrobot", "--theta", "1"]) == 2
    assert "has several joints; expected --q, --r and --json alone" in capsys.readouterr().err
