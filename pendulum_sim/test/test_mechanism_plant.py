"""Plants of several joints, stepped: energy, friction, stops, lag and delay."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_sim.exports.model_files import mjcf
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_testing.joint_plants import without_friction

_PLANTS = ("cart_pole", "acrobot", "furuta", "reaction_wheel", "triple_pendulum")


def _free(name: str):
    plant = without_friction(load_mechanism(name))
    return plant if name != "cart_pole" else plant.with_values({"cart.lower_stop": -1e3, "cart.upper_stop": 1e3})


@pytest.mark.parametrize("name", _PLANTS)
def test_energy_is_conserved_without_friction_to_the_order_of_the_integrator(name: str) -> None:
    drifts = []
    for substeps in (1, 2):
        plant = MechanismPlant(_free(name), 2e-3, substeps=substeps)
        n, still = len(plant.parameters.joints), (0.0,) * len(plant.parameters.effort_limits)
        plant.reset((0.1, 2.0, -0.5)[:n], (0.5, -1.0, 2.0)[:n])
        before = plant.energy
        for _ in range(500):
            plant.step(still)
        drifts.append(abs(plant.energy - before) / abs(before))
    assert drifts[0] < 1e-4
    assert drifts[1] < drifts[0] / 8.0 or drifts[1] < 1e-13


@pytest.mark.parametrize("name", _PLANTS)
def test_a_step_under_torque_is_that_of_an_adaptive_integrator(name: str) -> None:
    parameters = _free(name)
    n, limit = len(parameters.joints), parameters.effort_limits[0]
    plant = MechanismPlant(parameters, 1e-3)
    q, v, push = (0.2, -0.4, 0.6)[:n], (0.3, 1.0, -0.7)[:n], (0.01 * limit, -0.02 * limit, 0.03 * limit)[:n]
    effort = (0.3 * limit,) * len(parameters.effort_limits)
    plant.reset(q, v)
    for _ in range(200):
        state = plant.step(effort, push)
    total = np.add(parameters.coordinates.spread(effort), push)

    def flow(_t: float, x: np.ndarray) -> list[float]:
        return [*x[n:], *parameters.acceleration(tuple(x[:n]), tuple(x[n:]), tuple(total))]

    end = scipy.integrate.solve_ivp(flow, (0.0, 0.2), [*q, *v], rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose([*state.position, *state.velocity], end, rtol=2e-5, atol=1e-6)
    assert state.time == pytest.approx(0.2)


def test_one_joint_with_dry_friction_moves_as_the_one_joint_plant_does() -> None:
    one, many = RigidPlant(load_plant("dfki"), 1e-3, method="rk4"), MechanismPlant(load_mechanism("dfki"), 1e-3)
    one.reset(1.0, 0.0)
    many.reset((1.0,), (0.0,))
    for k in range(9000):
        effort = 0.8 * math.sin(0.004 * k) if k < 1000 else 0.0
        state, single = many.step((effort,)), one.step(effort)
        assert state.position[0] == pytest.approx(single.theta, abs=1e-9)
        assert state.velocity[0] == pytest.approx(single.theta_dot, abs=1e-9)
    assert state.velocity == (single.theta_dot,) == (0.0,)


def test_joints_within_their_friction_rest_to_the_last_bit() -> None:
    plant = MechanismPlant(load_mechanism("acrobot"), 2e-3)
    start = plant.reset((0.03, 0.02))
    for _ in range(200):
        state = plant.step((0.05,))
    assert state.position == start.position
    assert state.velocity == (0.0, 0.0)


@pytest.mark.parametrize(("name", "still"), [("acrobot", (0.5,)), ("triple_pendulum", (0.5, -0.4))])
def test_joints_that_are_held_are_welded_while_another_swings(name: str, still: tuple[float, ...]) -> None:
    # Their friction is far above what the swinging shoulder can ask of them.
    held = load_mechanism(name).coordinates.names[1:]
    stuck = {f"{joint}.coulomb_friction": 500.0 for joint in held}
    parameters = load_mechanism(name).with_values({**stuck, "shoulder.coulomb_friction": 0.0})
    plant = MechanismPlant(parameters, 1e-3)
    plant.reset((1.0, *still))
    before = plant.energy
    for _ in range(1000):
        state = plant.step((0.0,) * len(parameters.effort_limits))
        assert state.position[1:] == still
        assert state.velocity[1:] == (0.0,) * len(still)
    assert abs(state.velocity[0]) + abs(state.position[0] - 1.0) > 0.1
    lost = parameters.joints[0].damping
    assert plant.energy <= before
    assert plant.energy == pytest.approx(before, abs=20.0 * lost)


def test_dry_friction_takes_energy_until_everything_rests() -> None:
    plant = MechanismPlant(load_mechanism("double_pendulum"), 2e-3)
    plant.reset((1.0, 0.5), (1.0, -4.0))
    energies = [plant.energy]
    for _ in range(5000):
        state = plant.step((0.0, 0.0))
        energies.append(plant.energy)
    assert max(np.diff(energies)) < 1e-6
    assert state.velocity == (0.0, 0.0)


def test_sliding_friction_agrees_with_mujoco_where_its_regularised_one_is_stiff() -> None:
    mujoco = pytest.importorskip("mujoco")
    parameters = load_mechanism("double_pendulum")
    model = mujoco.MjModel.from_xml_string(mjcf(parameters))
    model.opt.timestep = 1e-4
    model.dof_solimp[:], model.dof_solref[:] = (0.9999, 0.9999, 1e-3, 0.5, 2.0), (2e-3, 1.0)
    data = mujoco.MjData(model)
    plant = MechanismPlant(parameters, 1e-3)
    plant.reset((0.5, 0.5), (8.0, 8.0))
    data.qpos[:], data.qvel[:] = (0.5, 0.5), (8.0, 8.0)
    for count, tolerance in ((40, 1e-9), (60, 1e-3)):  # The elbow turns round in the second part.
        for _ in range(count):
            state = plant.step((0.0, 0.0))
        mujoco.mj_step(model, data, nstep=10 * count)
        np.testing.assert_allclose(state.position, data.qpos, atol=tolerance)
    assert state.velocity[1] < 0.0


def test_a_cart_stops_at_the_end_of_its_track_and_its_pole_swings_on() -> None:
    plant = MechanismPlant(load_mechanism("cart_pole"), 2e-3)
    plant.reset((1.7, 0.0), (1.0, 0.0))
    hit = next(state for _ in range(200) if (state := plant.step((5.0,))).position[0] == 1.8)
    assert hit.velocity[0] == 0.0
    # The pole hangs behind a cart that stops: its tip goes on.
    assert hit.velocity[1] > 0.0
    for _ in range(20):
        state = plant.step((10.0,))
        assert state.position[0] == 1.8
        assert state.velocity[0] == 0.0
    for _ in range(200):
        state = plant.step((-10.0,))
    assert -1.8 <= state.position[0] < 1.8


def test_an_impact_keeps_the_momentum_that_the_stop_does_not_take() -> None:
    parameters = without_friction(load_mechanism("cart_pole")).with_values({"gravity": 0.0})
    plant = MechanismPlant(parameters, 1e-3)
    plant.reset((1.79, 0.3), (1.0, 0.5))
    before = plant.state
    while plant.state.position[0] < 1.8:
        before = plant.state
        plant.step((0.0,))
    after = plant.state
    # About the hinge no impulse acts on the pole: J theta' + m c cos(theta) x' is the same before and after.
    momenta = [
        np.array(parameters.mechanism.mass(state.position, parameters.packed))[1] @ state.velocity
        for state in (before, after)
    ]
    assert momenta[1] == pytest.approx(momenta[0], rel=5e-3)


def test_effort_is_clamped_delayed_and_lags() -> None:
    parameters = load_mechanism("acrobot_frictionless").with_values(
        {"elbow.transport_delay": 0.005, "elbow.time_constant": 0.01}
    )
    plant = MechanismPlant(parameters, 2e-3)
    plant.reset()
    efforts = [plant.step((100.0,)).effort for _ in range(6)]
    assert efforts[1] == (0.0, 0.0)
    expected = 6.0 * (1.0 - math.exp(-(6 * 2e-3 - 0.005) / 0.01))
    assert efforts[-1] == pytest.approx((0.0, expected))


def test_starts_steps_and_efforts_that_no_plant_can_take_are_refused() -> None:
    plant = MechanismPlant(load_mechanism("cart_pole"), 2e-3)
    with pytest.raises(ParameterError, match=r"initial cart is 2.0 m; expected -1.8 to 1.8, between its stops"):
        plant.reset((2.0, 0.0))
    with pytest.raises(ParameterError, match=r"initial position is \[nan, 0.0\]; expected 2 finite numbers, for cart"):
        plant.reset((math.nan, 0.0))
    with pytest.raises(ParameterError, match=r"effort has 2 values; expected 1, for cart"):
        plant.step((1.0, 1.0))
    with pytest.raises(ParameterError, match=r"push has 1 values; expected 2, one per joint"):
        plant.step((1.0,), (1.0,))
    stiff = load_mechanism("furuta").with_values({"pendulum.damping": 1.0})
    with pytest.raises(ParameterError, match=r"step is 0.002 s on plant 'furuta', whose damping decays at"):
        MechanismPlant(stiff, 2e-3)
    uneven = load_mechanism("double_pendulum").with_values({"elbow.transport_delay": 0.01})
    with pytest.raises(ParameterError, match=r"transport_delay is 0.0 s and 0.01 s on plant 'double_pendulum'"):
        MechanismPlant(uneven, 2e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_effort_is_made_of_a_command_that_is_no_number(bad: float) -> None:
    plant = MechanismPlant(load_mechanism("acrobot"), 2e-3)
    start = plant.reset((0.3, 0.2))
    for effort, push in (((bad,), None), ((0.0,), (bad, 0.0))):
        with pytest.raises(ParameterError, match="expected finite numbers"):
            plant.step(effort, push)
        assert plant.state == start


def test_a_joint_that_turns_round_at_its_stop_within_a_step_is_not_beyond_it() -> None:
    arm = load_mechanism("furuta").with_values({"pendulum.coulomb_friction": 0.3, "pendulum.upper_stop": 1.0})
    # Friction brings it to rest past the stop within the step, however short the way is.
    plant = MechanismPlant(arm, 2e-3)
    for start in np.linspace(0.05, 1.5, 30):
        plant.reset((0.0, 1.0 - 1e-5), (0.0, float(start)))
        assert plant.step((0.0,)).position[1] <= 1.0


def test_dry_friction_holds_no_joint_against_an_impact() -> None:
    def after(friction: float) -> tuple:
        cart = load_mechanism("cart_pole").with_values(
            {"cart.coulomb_friction": friction, "pole.upper_stop": 1.0, "pole.damping": 0.0}
        )
        plant = MechanismPlant(cart, 1e-4)
        plant.reset((0.0, 0.999), (0.0, 20.0))
        return plant.step((0.0,)).velocity

    # Friction that holds the cart while the pole swings, and the one of it that hardly slows it after the blow.
    assert after(1.0)[0] == pytest.approx(after(0.0)[0], rel=0.5)
    assert abs(after(50.0)[0]) > 0.1 * abs(after(0.0)[0])
