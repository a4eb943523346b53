"""Linear models and LQR of plants of several joints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.design_command.design_cli import main
from pendulum_lqr.design_command.figures import release_figure
from pendulum_lqr.linear.analysis import analyse, delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError, continuous_lqr, output_lqr
from pendulum_lqr.linear.model import holding_effort, linearise
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant, write_plant
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.joint_plants import lagging_plant, near_upright, without_friction

_PLANTS = ("cart_pole", "acrobot", "pendubot", "double_pendulum", "furuta", "reaction_wheel", "triple_pendulum")


@pytest.mark.parametrize("name", ["thesis", "dfki"])
def test_the_model_of_one_joint_is_that_of_the_one_joint_design_bit_for_bit(name: str) -> None:
    one, many = linearise(load_plant(name)), linearise(load_mechanism(name))
    assert np.array_equal(one.A, many.A)
    assert np.array_equal(one.B, many.B)
    assert np.array_equal(one.E, many.E)
    assert many.position == (one.theta,)
    assert many.efforts == (one.effort,) == (0.0,)
    gain = output_lqr(many, (100.0, 0.01), 0.1)
    assert np.array_equal(gain.K, continuous_lqr(one, (100.0, 0.01), 0.1).K)


@pytest.mark.parametrize("name", _PLANTS)
def test_the_linear_model_has_the_slopes_of_the_equations(name: str) -> None:
    plant = load_mechanism(name)
    model = linearise(plant)
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
    model = linearise(plant)
    gain = output_lqr(model, *plant.mechanism.weights)
    assert gain.rows.shape == (len(plant.coordinates.driven), 2 * len(plant.joints))
    n = len(plant.joints)

    def flow(_t: float, x: np.ndarray) -> list[float]:
        deviation = np.array([*plant.coordinates.deviation(tuple(x[:n])), *x[n:]])
        u = tuple(np.clip(-gain.rows @ deviation, *(np.array(plant.effort_limits) * sign for sign in (-1, 1))))
        return [*x[n:], *plant.acceleration(tuple(x[:n]), tuple(x[n:]), plant.coordinates.spread(u))]

    start = np.array([*plant.coordinates.goal, *(0.0,) * n])
    start[n - 1] += 0.02
    end = scipy.integrate.solve_ivp(flow, (0.0, -12.0 / gain.poles[0].real), start, rtol=1e-8, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(end, [*plant.coordinates.goal, *(0.0,) * n], atol=1e-3)


@pytest.mark.parametrize("name", _PLANTS)
def test_the_lag_of_each_actuator_is_a_state_and_a_design_without_it_falls_where_this_one_stands(name: str) -> None:
    plant = lagging_plant(load_mechanism(name), 0.06)
    n, m = len(plant.joints), len(plant.coordinates.driven)
    model, prompt = linearise(plant), linearise(load_mechanism(name))
    assert model.hidden == tuple(f"{joint}_effort" for joint in plant.coordinates.driven_names)
    np.testing.assert_allclose(model.A[2 * n :, 2 * n :], -np.eye(m) / 0.06)
    np.testing.assert_allclose(model.A[: 2 * n, 2 * n :], prompt.B)
    np.testing.assert_allclose(model.A[: 2 * n, : 2 * n], prompt.A)
    np.testing.assert_allclose(model.B, np.vstack([np.zeros((2 * n, m)), np.eye(m) / 0.06]))
    np.testing.assert_allclose(model.E, np.vstack([prompt.E, np.zeros((m, n))]))
    assert delayed_spectral_radius(model, output_lqr(model, *plant.mechanism.weights).K, 0.002) < 1.0
    unaware = output_lqr(prompt, *plant.mechanism.weights).K
    assert (delayed_spectral_radius(model, unaware, 0.01) > 1.0) == (
        name in {"acrobot", "pendubot", "furuta", "reaction_wheel"}
    )


def test_only_the_actuator_that_lags_has_a_state_and_its_gain_is_best_among_all_on_what_is_measured() -> None:
    plant = load_mechanism("double_pendulum").with_values({"elbow.time_constant": 0.03})
    model = linearise(plant)
    assert model.states == ("shoulder", "elbow", "shoulder_dot", "elbow_dot", "elbow_effort")
    q, r = plant.mechanism.weights
    gain = output_lqr(model, q, r)
    assert gain.K.shape == (2, 4)

    def cost(K: np.ndarray) -> float:
        closed = model.A - model.B @ K @ model.C
        weight = model.C.T @ (np.diag(q) + r * K.T @ K) @ model.C
        return float(np.trace(scipy.linalg.solve_continuous_lyapunov(closed.T, -weight)[:4, :4]))

    best = cost(gain.K)
    assert np.trace(gain.S) == pytest.approx(best)
    generator = np.random.default_rng(1)
    assert all(cost(gain.K * (1.0 + 0.02 * generator.standard_normal((2, 4)))) > best for _ in range(20))


@pytest.mark.parametrize("name", _PLANTS)
@pytest.mark.parametrize("controller", ["lqr", "lqi", "discrete_lqr", "lqg", "mpc"])
def test_every_controller_holds_the_lagging_plant_or_refuses_it(name: str, controller: str) -> None:
    plant = without_friction(lagging_plant(load_mechanism(name), 0.06))
    if (name, controller) in {("furuta", "lqr"), ("furuta", "lqi"), ("reaction_wheel", "lqi")}:
        with pytest.raises(DesignError, match=f"{controller} asked every 0.01 s does not settle on plant '{name}'"):
            make_controller(controller, plant, 0.01)
        return
    made = make_controller(controller, plant, 0.01)
    simulated = MechanismPlant(plant, dt=0.01)
    state = simulated.reset(near_upright(plant, *(1e-3,) * len(plant.joints)))
    for k in range(2500 if name == "reaction_wheel" else 1500):
        state = simulated.step(made.efforts(0.01 * k, state.position, state.velocity))
    assert np.abs(plant.coordinates.deviation(state.position)).max() < 1e-6


def test_sampled_designs_and_margins_take_a_model_of_several_joints() -> None:
    model = linearise(load_mechanism("cart_pole"))
    q, r = load_mechanism("cart_pole").mechanism.weights
    cost, cost_r, cross = sampled_cost(model, q, r, 1e-3)
    sampled = discrete_lqr(discretise(model, 1e-3), cost, cost_r, cross)
    continuous = output_lqr(model, q, r)
    np.testing.assert_allclose(sampled.K, continuous.K, rtol=0.02)
    report = analyse(model, continuous.K)
    assert report.margins is not None
    assert report.margins.modulus == pytest.approx(1.0, abs=1e-6)
    assert report.largest_period is not None
    assert 0.0 < report.largest_period < 1.0


def test_the_command_shows_the_lag_and_which_row_does_not_settle_with_the_delay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = lagging_plant(load_mechanism("cart_pole"), 0.03).with_values({"cart.transport_delay": 0.06})
    file = str(write_plant(tmp_path / "late.yaml", plant))
    weights = ["--q", "10,100,1,1", "--r", "0.1", "--r", "100"]
    assert main(["--plant", file, *weights]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "cart_effort not measured: K is the best gain on positions and velocities alone" in shown
    assert "transport delay 0.06 s" in shown
    assert "unstable" in shown
    assert main(["--plant", file, *weights, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["stable"] for row in rows] == [False, False, True]
    model = linearise(plant)
    assert [delayed_spectral_radius(model, row["K"], 1e-3) < 1.0 for row in rows[1:]] == [False, True]


def test_a_position_is_held_by_driven_joints_and_refused_where_a_passive_one_falls() -> None:
    both = load_mechanism("double_pendulum")
    q = (2.0, 0.5)
    efforts = holding_effort(both, q)
    assert both.acceleration(q, (0.0, 0.0), efforts) == pytest.approx((0.0, 0.0), abs=1e-9)
    with pytest.raises(ParameterError, match=r"shoulder is passive and would fall from 2 rad with -?\d"):
        linearise(load_mechanism("acrobot"), q)
    with pytest.raises(ParameterError, match=r"position is \[1.0\]; expected 2 finite numbers, for shoulder \[rad\]"):
        linearise(both, (1.0,))


def test_weights_of_another_shape_are_refused() -> None:
    model = linearise(load_mechanism("double_pendulum"))
    with pytest.raises(DesignError, match=r"q has the shape \(2,\); expected \(4,\)"):
        output_lqr(model, (1.0, 1.0), 1.0)
    for r in (0.0, (1.0, -1.0), (1.0, 1.0, 1.0)):
        with pytest.raises(DesignError, match=r"expected one finite weight > 0, or 2"):
            output_lqr(model, (1.0,) * 4, r)


def test_an_arm_that_gravity_does_not_move_past_upright_is_refused_where_no_torque_reaches_it() -> None:
    flat = load_mechanism("acrobot_frictionless").with_values({"gravity": 0.0})
    with pytest.raises(DesignError, match="is not controllable"):
        output_lqr(linearise(flat), (1.0,) * 4, 1.0)


def test_the_command_prints_gains_of_several_joints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--preset", "acrobot", "--q", "10,10,1,1", "--r", "1", "--r", "10", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    gain = output_lqr(linearise(load_mechanism("acrobot")), (10.0, 10.0, 1.0, 1.0), 10.0)
    assert document["rows"][2]["K"] == gain.K.tolist()
    assert document["driven"] == ["elbow"]
    assert main(["--preset", "double_pendulum"]) == 0
    assert "states shoulder, elbow, shoulder_dot, elbow_dot" in capsys.readouterr().out
    assert main(["--preset", "acrobot", "--q", "1,1"]) == 2
    assert "expected 4 numbers, for shoulder, elbow, shoulder_dot, elbow_dot" in capsys.readouterr().err
    assert main(["--preset", "acrobot", "--theta", "1"]) == 2
    assert "expected --theta, --effort-limit and --tracking left out: a passive joint" in capsys.readouterr().err


def test_the_worst_case_of_a_mechanism_is_that_of_its_own_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    uncertain = ["--uncertainty", "pole_mass=50%", "--uncertainty", "cart.transport_delay=0:0.2"]
    assert main(["--preset", "cart_pole", *uncertain, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    bounds = document["uncertainty"]["bounds"]
    assert bounds == {"pole_mass": pytest.approx([0.05, 0.15]), "cart.transport_delay": [0.0, 0.2]}
    worst, plant = document["rows"][1]["worst_case"], load_mechanism("cart_pole")
    gain = output_lqr(linearise(plant), *plant.mechanism.weights).K
    # The worst plant is one that the sampled loop, which shares no margins with it, loses too.
    assert 0 < worst["unstable"] < worst["plants"]
    assert delayed_spectral_radius(linearise(plant.with_values(worst["where"])), gain, 1e-3) > 1.0
    file = write_plant(
        tmp_path / "p.yaml", plant, provenance={"source": "a test"}, intervals={"pole_mass": [0.09, 0.11]}
    )
    assert main(["--plant", str(file), "--uncertainty", "identified"]) == 0
    assert "holds every one of 51 plants over pole_mass 0.09 to 0.11 kg" in " ".join(capsys.readouterr().out.split())
    for options, sentence in (
        (["cart_pole", "--uncertainty", "mass_2=10%"], "--uncertainty names 'mass_2'"),
        (["double_pendulum", "--uncertainty", "mass_2=10%"], "has 2 motors; expected --machine and --uncertainty left"),
    ):
        assert main(["--preset", *options]) == 2
        assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(("name", "figures"), [("reaction_wheel", 4), ("triple_pendulum", 3)])
def test_figures_of_mechanisms_show_a_release(name: str, figures: int, tmp_path: Path) -> None:
    assert main(["--preset", name, "--figures", str(tmp_path)]) == 0
    assert len(list(tmp_path.glob("*.png"))) == figures
    plant = load_mechanism(name)
    gain = output_lqr(linearise(plant), *plant.mechanism.weights)
    figure = release_figure(plant, linearise(plant), {"own": gain.K})
    swung = [np.asarray(ax.lines[0].get_ydata()) for ax in figure.axes]
    assert swung[0][0] == pytest.approx(0.05)
    assert all(abs(values[-1]) < 0.15 * np.max(np.abs(values)) for values in swung)
