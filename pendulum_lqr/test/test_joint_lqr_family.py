"""The LQR's relatives for several joints: discrete, with integrals, and with a Kalman filter."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import control
import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.lqg import Lqg
from pendulum_lqr.linear.analysis import delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError, kalman_gain
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.joint_plants import delayed_plant, lagging_plant, near_upright

PLANTS = ("acrobot_frictionless", "pendubot_frictionless", "double_pendulum", "cart_pole", "furuta")
PERIOD = 0.01


class _Run:
    """Ten seconds from 0.02 rad or m off upright: deviations and efforts."""

    def __init__(
        self,
        plant: PlantParameters,
        controller: Controller,
        *,
        noise: tuple[float, float] = (0.0, 0.0),
        push: float = 0.0,
        period: float = PERIOD,
    ) -> None:
        n = len(plant.joints)
        rng = np.random.default_rng(4)
        simulated = MechanismPlant(plant, dt=period)
        state = simulated.reset(near_upright(plant, *(0.02,) * n))
        pushes = tuple(push if joint == plant.coordinates.driven[0] else 0.0 for joint in range(n))
        deviations, efforts = [], []
        for k in range(round(10.0 / period)):
            q = np.array(state.position) + noise[0] * rng.standard_normal(n)
            v = np.array(state.velocity) + noise[1] * rng.standard_normal(n)
            efforts.append(controller.efforts(k * period, tuple(map(float, q)), tuple(map(float, v))))
            state = simulated.step(efforts[-1], pushes)
            deviations.append(plant.coordinates.deviation(state.position))
        self.deviations, self.efforts = np.array(deviations), np.array(efforts)


def test_the_discrete_lqr_holds_a_delayed_plant_that_the_sampled_one_cannot() -> None:
    plant = delayed_plant("furuta", 0.012)
    with pytest.raises(ParameterError, match=r"lqr asked every 0\.01 s does not settle on plant 'furuta'"):
        make_controller("lqr", plant, PERIOD)
    controller = make_controller("discrete_lqr", plant, PERIOD)
    assert controller.describe().endswith(", 2 efforts on their way")
    first = _Run(plant, controller)
    assert np.abs(first.deviations[-1]).max() < 1e-3
    controller.reset()
    assert (_Run(plant, controller).efforts == first.efforts).all()
    # Who takes over knows what is on its way; who begins does not.
    successor, stranger = (make_controller("discrete_lqr", plant, PERIOD) for _ in range(2))
    asked = (near_upright(plant, 0.1, 0.1), (0.0, 0.0))
    controller.efforts(0.0, *asked)
    successor.carry_over(controller)
    expected = controller.efforts(0.01, *asked)
    assert successor.efforts(0.01, *asked) == expected
    assert stranger.efforts(0.01, *asked) != expected
    with pytest.raises(ParameterError, match=r"the loop is predicted every 0\.01 s; expected states at that period"):
        controller.check(0.002)


@pytest.mark.parametrize("name", ["cart_pole", "double_pendulum"])
def test_integrals_leave_no_offset_of_the_driven_joints_under_a_constant_effort(name: str) -> None:
    plant = load_mechanism(name)
    push = 0.05 * plant.effort_limits[0]
    driven = list(plant.coordinates.driven)
    plain = _Run(plant, make_controller("lqr", plant, PERIOD), push=push)
    controller = make_controller("lqi", plant, PERIOD)
    assert np.abs(plain.deviations[-1][driven]).max() > 0.01
    assert np.abs(_Run(plant, controller, push=push).deviations[-1][driven]).max() < 0.002
    # Beyond the limit nothing is wound up.
    controller.reset()
    fresh = controller.efforts(0.0, near_upright(plant, 0.0, 0.0), (0.0, 0.0))
    for k in range(200):
        far = controller.efforts(k * PERIOD, near_upright(plant, 0.0, 1.0), (0.0, 0.0))
    assert max(map(abs, far)) == max(plant.effort_limits)
    assert controller.efforts(2.0, near_upright(plant, 0.0, 0.0), (0.0, 0.0)) == fresh
    # Another weight does not let go of what the integrals hold; who begins anew does.
    _Run(plant, controller, push=push)
    controller.reset()
    assert controller.efforts(0.0, near_upright(plant, 0.0, 0.0), (0.0, 0.0)) == fresh
    _Run(plant, controller, push=push)
    other = make_controller("lqi", plant, PERIOD, {"q_integral": 30.0})
    other.carry_over(controller)
    upright = (plant.coordinates.goal, (0.0, 0.0))
    held = controller.efforts(0.0, *upright)
    assert held[0] < -0.8 * push
    assert other.efforts(0.0, *upright) == pytest.approx(held)
    with pytest.raises(ParameterError, match=r"it is integrated every 0\.01 s"):
        controller.check(0.002)
    with pytest.raises(ParameterError, match=r"lqi asked every 1 s does not settle"):
        make_controller("lqi", plant, 1.0)
    # Designed before anybody knows the period, it is judged when that turns out to be the assumed one.
    with pytest.raises(ParameterError, match=r"lqi asked every 0\.01 s does not settle on plant 'furuta'"):
        make_controller("lqi", delayed_plant("furuta", 0.012), 0.01, checked=False).check(PERIOD)


@pytest.mark.parametrize("name", ["cart_pole", "acrobot_frictionless", "double_pendulum"])
def test_an_integral_unwinds_at_the_limit_joint_by_joint_whatever_the_sign_of_its_gain(name: str) -> None:
    plant = load_mechanism(name)
    driven, n = plant.coordinates.driven, len(plant.joints)
    controller = make_controller("lqi", plant, PERIOD)
    own = np.diag(controller.gain.rows[:, 2 * n :])
    hold = tuple(0.0 for _ in range(n))
    for count, joint in enumerate(driven):
        controller.reset()
        # A small offset fills the integral; then velocity drives the effort to its limit on the same side.
        side = [0.0] * n
        side[joint] = 1e-3
        for k in range(1000):
            controller.efforts(k * PERIOD, near_upright(plant, *side), hold)
        filled = np.array(controller.memory)
        assert filled[count] == pytest.approx(10.0 * 1e-3, rel=1e-6)
        fast = np.linalg.lstsq(controller.gain.rows[:, n : 2 * n], np.eye(len(driven))[count], rcond=None)[0]
        velocity = tuple(map(float, -100.0 * np.sign(-own[count]) * fast))
        for sign in (-1.0, 1.0):
            before = np.array(controller.memory)
            side[joint] = sign * 1e-3
            for k in range(100):
                efforts = controller.efforts(k * PERIOD, near_upright(plant, *side), velocity)
                assert abs(efforts[count]) == plant.effort_limits[count]
            # Away from the limit it goes, further beyond it does not, and no other joint's moves.
            change = np.array(controller.memory) - before
            assert change[count] == pytest.approx(-1e-3 if sign < 0.0 else 0.0, rel=1e-6, abs=1e-12)
            assert np.abs(np.delete(change, count)).max(initial=0.0) < 1e-12


def test_the_spectral_radius_of_a_loop_with_integrals_is_that_of_the_law_as_it_answers() -> None:
    plant = lagging_plant(delayed_plant("double_pendulum", 0.003), 0.01)
    controller = make_controller("lqi", plant, PERIOD, {"q_integral": 50.0})
    controller.effort_limits = (math.inf, math.inf)
    model = linearise(plant)
    sampled, goal = discretise(model, PERIOD), np.array(plant.coordinates.goal)
    columns = []
    for start in 1e-3 * np.eye(len(sampled.A) + 2):
        z, controller.memory = start[:-2], start[-2:].tolist()
        u = controller.efforts(0.0, tuple(map(float, goal + z[:2])), tuple(map(float, z[2:4])))
        columns.append(1e3 * np.array([*(sampled.A @ z + sampled.B @ u), *controller.memory]))
    found = float(np.abs(np.linalg.eigvals(np.array(columns).T)).max())
    K = controller.gain.rows * np.array([1.0] * 4 + [PERIOD] * 2)
    assert delayed_spectral_radius(model, K, PERIOD, summed=(0, 1)) == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("name", ["lqi", "lqg", "discrete_lqr"])
def test_the_limit_that_is_given_holds(name: str) -> None:
    plant = load_mechanism("cart_pole")
    controller = make_controller(name, plant, PERIOD, {"effort_limit": 2.0})
    for side in (1.0, -1.0):
        (effort,) = controller.efforts(0.0, near_upright(plant, 0.0, side), (0.0, 0.0))
        assert abs(effort) == 2.0


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.013])
def test_what_the_filter_predicts_comes(delay: float) -> None:
    plant = delayed_plant("cart_pole", delay)
    controller = make_controller("lqg", plant, PERIOD)
    simulated = MechanismPlant(plant, dt=PERIOD)
    state = simulated.reset(near_upright(plant, 0.0, 0.002))
    surprises, states = [], []
    for k in range(100):
        states.append(np.array([*plant.coordinates.deviation(state.position), *state.velocity]))
        if (predicted := controller.observer._estimate) is not None:
            surprises.append(np.abs(states[-1] - predicted))
        state = simulated.step(controller.efforts(k * PERIOD, state.position, state.velocity))
    assert np.max(surprises) < 0.05 * np.max(np.abs(np.diff(states, axis=0)))


@pytest.mark.parametrize("name", PLANTS)
def test_the_gain_with_integrals_is_that_of_python_control(name: str) -> None:
    plant = load_mechanism(name)
    model = linearise(plant)
    driven, m = plant.coordinates.driven, len(plant.coordinates.driven)
    integrated = np.eye(4)[list(driven)]
    A = np.block([[model.A, np.zeros((4, m))], [integrated, np.zeros((m, m))]])
    B = np.vstack([model.B, np.zeros((m, m))])
    q, r = plant.mechanism.weights
    K, _, _ = control.lqr(A, B, np.diag([*q, *(10.0,) * m]), r * np.eye(m))
    controller = make_controller("lqi", plant, PERIOD)
    assert pytest.approx(K, rel=1e-6, abs=1e-9) == controller.gain.rows


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("delay", [0.0, 0.013])
def test_the_filter_asks_for_a_fraction_of_the_effort_where_velocities_are_noise(name: str, delay: float) -> None:
    plant = delayed_plant(name, delay)
    noise = (2e-4, 0.05)
    plain = _Run(plant, make_controller("discrete_lqr", plant, PERIOD), noise=noise)
    filtered = _Run(plant, make_controller("lqg", plant, PERIOD), noise=noise)
    late = slice(-500, None)
    assert np.abs(filtered.deviations[late]).max() < 0.03
    if name == "furuta":  # its LQR is calm, and its dry friction hides what is left
        return
    assert np.std(np.diff(filtered.efforts[late], axis=0)) < 0.4 * np.std(np.diff(plain.efforts[late], axis=0))


def test_the_filter_is_that_of_python_control_and_uses_velocities_where_their_noise_is_reported() -> None:
    plant = load_mechanism("cart_pole")
    model = linearise(plant)
    sampled = discretise(model, PERIOD)
    E = discretise(replace(model, B=model.E), PERIOD).B
    values = {"position_noise": 1e-3, "velocity_noise": 0.02, "effort_noise": 0.3}
    for chosen, C, V in (
        ({**values, "velocity_noise": 0.0}, np.eye(2, 4), 1e-6 * np.eye(2)),
        (values, np.eye(4), np.diag([1e-6, 1e-6, 4e-4, 4e-4])),
    ):
        controller = make_controller("lqg", plant, PERIOD, chosen)
        _, P, _ = control.dlqe(sampled.A, E, C, 0.09 * np.eye(2), V)
        L = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        assert pytest.approx(L, rel=1e-6, abs=1e-9) == controller.observer.gain
    assert {spec.name for spec in Lqg.parameters(plant)} >= set(values)


def test_the_filter_follows_its_model_through_delay_and_whole_turns_and_forgets_what_is_beyond_all_bounds() -> None:
    plant = delayed_plant("pendubot_frictionless", 0.013)
    controller = make_controller("lqg", plant, PERIOD)
    run = _Run(plant, controller)
    assert np.abs(run.deviations[-1]).max() < 1e-4

    def seen(position, velocity):
        return controller.observer.correct(controller.deviation(position), velocity)[:4]

    # A turn of the elbow is no surprise: its deviation jumps from one end of the circle to the other.
    controller.reset()
    near, beyond = (near_upright(plant, 0.0, side * (math.pi - 1e-3)) for side in (1.0, -1.0))
    controller.efforts(0.0, near, (0.0, 0.2))
    estimate = seen(beyond, (0.0, 0.2))
    assert abs(estimate[1]) == pytest.approx(math.pi, abs=0.1)
    assert abs(estimate[3]) < 3.0
    # The first velocity is believed, also where velocities are not used.
    controller.reset()
    assert seen(near, (0.3, 0.2)) == pytest.approx([0.0, math.pi - 1e-3, 0.3, 0.2])
    controller.reset()
    controller.efforts(0.0, plant.coordinates.goal, (sys.float_info.max, 0.0))
    assert seen(plant.coordinates.goal, (0.1, 0.2)) == pytest.approx([0.0, 0.0, 0.1, 0.2])
    # Who takes over goes on with the estimate.
    controller.reset()
    controller.efforts(0.0, near_upright(plant, 0.01, 0.0), (0.5, 0.0))
    successor = make_controller("lqg", plant, PERIOD)
    successor.carry_over(controller)
    here = (near_upright(plant, 0.015, 0.0), (0.0, 0.0))
    assert successor.efforts(0.01, *here) == pytest.approx(controller.efforts(0.01, *here), rel=1e-9)


def test_a_covariance_of_few_causes_is_taken_and_a_negative_one_refused() -> None:
    direction = np.array([[1.0], [1e3]])
    scaled = 0.3 * direction @ direction.T
    assert np.isfinite(kalman_gain(np.eye(2), np.eye(2), scaled, np.eye(2)).L).all()
    for bad in (np.diag([1.0, -1e-3]), np.diag([1.0, math.nan])):
        with pytest.raises(DesignError, match=r"process noise covariance is .*; expected finite, not negative"):
            kalman_gain(np.eye(2), np.eye(2), bad, np.eye(2))


FAMILY = ("lqr", "lqi", "discrete_lqr", "lqg", "mpc")


@pytest.mark.parametrize("name", FAMILY)
def test_a_set_point_is_held_by_its_own_efforts_and_judged_there(name: str) -> None:
    plant, offsets = load_mechanism("double_pendulum"), [1.5, 0.0]
    # About upright the gain of this set-point would not settle.
    position = tuple(goal + off for goal, off in zip(plant.coordinates.goal, offsets, strict=True))
    for feedforward in (True, False):
        values = {"set_point": offsets, "feedforward": feedforward}
        controller = make_controller(name, plant, 0.02, values)
        efforts = controller.efforts(0.0, position, (0.0, 0.0))
        expected = linearise(plant, position).efforts if feedforward else (0.0, 0.0)
        assert efforts == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", ["discrete_lqr", "lqg", "mpc"])
def test_a_delay_that_is_given_counts_as_the_plants_own(name: str) -> None:
    late, plant = delayed_plant("cart_pole", 0.013), load_mechanism("cart_pole")
    made = [
        make_controller(name, late, PERIOD),
        *(make_controller(name, plant, PERIOD, {"delay": d}) for d in (0.013, 0.0)),
    ]
    for k in range(4):
        state = (near_upright(plant, 0.001, 0.002 + 0.001 * k), (0.0, 0.1))
        own, given, prompt = (controller.efforts(k * PERIOD, *state) for controller in made)
        assert given == pytest.approx(own, rel=1e-9)
    assert prompt != pytest.approx(own, rel=0.01)


@pytest.mark.parametrize("cost", ["sum", "sampled"])
def test_the_discrete_lqr_has_the_gain_of_python_control_for_the_sum_of_samples_alone(cost: str) -> None:
    plant, period = load_mechanism("double_pendulum"), 0.02
    sampled, (q, r) = discretise(linearise(plant), period), plant.mechanism.weights
    K, _, _ = control.dlqr(sampled.A, sampled.B, np.diag(q), r * np.eye(2))
    gain = make_controller("discrete_lqr", plant, period, {"cost": cost}).gain.rows
    assert (gain == pytest.approx(K, rel=1e-6)) == (cost == "sum")


@pytest.mark.parametrize("name", ["lqg", "mpc"])
def test_a_constant_effort_that_is_estimated_leaves_no_offset(name: str) -> None:
    plant = load_mechanism("cart_pole")
    push = 0.05 * plant.effort_limits[0]
    without, with_it = (
        _Run(plant, make_controller(name, plant, PERIOD, {"offset_noise": noise}), push=push).deviations[-1, 0]
        for noise in (0.0, 1.0)
    )
    assert abs(with_it) < 0.002
    assert abs(without) > 0.01
