"""Linear MPC of several joints: the discrete LQR where nothing limits it, and within its limits elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controllers.mpc import LinearMpc
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.joint_plants import delayed_plant, near_upright

PLANTS = ("acrobot_frictionless", "pendubot_frictionless", "double_pendulum", "cart_pole", "furuta")
PERIOD = 0.01


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(("period", "horizon"), [(0.002, 50), (0.05, 20), (0.02, 200)])
def test_without_active_limits_it_is_the_discrete_lqr(name: str, period: float, horizon: int) -> None:
    plant = load_mechanism(name)
    controller = make_controller("mpc", plant, period, {"horizon": horizon})
    model = linearise(plant)
    cost = sampled_cost(model, *plant.mechanism.weights, period)
    K = np.atleast_2d(discrete_lqr(discretise(model, period), *cost).K)
    x = np.array([1e-3, -1e-3, 2e-3, -1e-3])
    effort = controller.efforts(0.0, near_upright(plant, *x[:2]), tuple(x[2:]))
    expected = np.array(model.efforts) - K @ x
    assert np.abs(expected).max() < min(plant.effort_limits)
    assert effort == pytest.approx(expected, rel=1e-3, abs=1e-4 * max(plant.effort_limits))


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013])
def test_the_cost_of_two_inputs_is_collected_as_that_of_one(delay: float) -> None:
    model = linearise(load_mechanism("double_pendulum"))
    q, r, period = (3.0, 2.0, 1.0, 0.5), 0.7, 0.01
    Q, R, N = sampled_cost(model, q, r, period, delay)
    sampled = discretise(model, period, delay)
    rng = np.random.default_rng(5)
    z, u = rng.normal(size=sampled.A.shape[0]), rng.normal(size=2)
    told = z @ Q @ z + 2.0 * z @ N @ u + u @ R @ u
    # By quadrature: in each piece of the period the inputs that act in it, oldest first.
    sent = np.concatenate([z[4:], u]).reshape(-1, 2)
    switch = delay - math.floor(delay / period + 1e-9) * period

    def flow(t: float, x: np.ndarray) -> np.ndarray:
        acting = sent[0] if t < switch or len(sent) == 1 or switch < 1e-12 else sent[1]
        return np.append(model.A @ x[:4] + model.B @ acting, x[:4] @ np.diag(q) @ x[:4])

    x = np.append(z[:4], 0.0)
    for begin, end in ((0.0, switch), (switch, period)):
        if end > begin + 1e-12:
            middle = 0.5 * (begin + end)
            solved = scipy.integrate.solve_ivp(
                lambda t, x, at=middle: flow(at, x), (begin, end), x, rtol=1e-10, atol=1e-12
            )
            x = solved.y[:, -1]
    assert told == pytest.approx(x[4] + r * period * (u @ u), rel=1e-7)


def _planned(controller: LinearMpc, x: np.ndarray, widths: Sequence[float], dear: float) -> np.ndarray:
    """Return the first inputs by the plant's own powers and a solver of another kind."""
    A, B, (Q, R, N), S = controller.sampled.A, controller.sampled.B, controller.cost, controller.gain.S
    m, horizon = B.shape[1], controller._program.horizon

    def states(u: np.ndarray) -> np.ndarray:
        way = [x]
        for each in u:
            way.append(A @ way[-1] + B @ each)
        return np.array(way)

    def cost(unknown: np.ndarray) -> float:
        u, slack = unknown[:-2].reshape(horizon, m), unknown[-2:]
        way = states(u)
        stages = sum(z @ Q @ z + 2.0 * z @ N @ v + v @ R @ v for z, v in zip(way, u, strict=False))
        return float(stages + way[-1] @ S @ way[-1] + dear * slack @ slack)

    def room(unknown: np.ndarray) -> np.ndarray:
        beyond = np.abs(states(unknown[:-2].reshape(horizon, m))[1:, :2]) - unknown[-2:] - np.array(widths)
        return -beyond.ravel()

    bounds = [(-limit, limit) for _ in range(horizon) for limit in controller.effort_limits] + [(0.0, None)] * 2
    found = scipy.optimize.minimize(
        cost, np.zeros(horizon * m + 2), method="SLSQP", bounds=bounds, constraints={"type": "ineq", "fun": room},
        options={"ftol": 1e-12, "maxiter": 500},
    )  # fmt: skip
    assert found.success
    return np.asarray(found.x[:m])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    "x",
    [(-0.08, 0.0, -0.25, 0.09), (0.07, -0.18, 0.0, -0.54), (-0.07, 0.14, -0.14, 0.1), (-0.06, 0.19, -0.13, 0.64),
     (-0.07, -0.15, -0.31, -0.72), (0.02, 0.05, -0.6, 1.35), (-0.03, -0.02, 0.67, 0.4)],
)  # fmt: skip
def test_two_inputs_with_limits_of_their_own_and_two_positions_are_planned_as_by_another_solver(
    x: tuple[float, ...], sign: float
) -> None:
    plant = load_mechanism("double_pendulum").with_values({"shoulder.effort_limit": 3.0, "elbow.effort_limit": 1.0})
    widths = [0.04, 0.1]
    controller = make_controller("mpc", plant, 0.02, {"horizon": 6, "position_limits": widths})
    assert isinstance(controller, LinearMpc)
    state = sign * np.array(x)
    dear = 10.0 * max(plant.mechanism.weights[0])
    answer = controller.efforts(0.0, near_upright(plant, *state[:2]), tuple(state[2:]))
    assert answer == pytest.approx(_planned(controller, state, widths, dear), abs=5e-3)


@pytest.mark.parametrize(("place", "velocity", "tilt"), [(1.5, 0.5, 0.0), (1.3, 1.0, 0.0), (1.6, 0.0, -0.05)])
def test_a_cart_that_an_lqr_lets_hit_the_end_of_its_track_stops_before_it(
    place: float, velocity: float, tilt: float
) -> None:
    plant = load_mechanism("cart_pole")
    farthest = {}
    for kind in ("lqr", "mpc"):
        controller = make_controller(kind, plant, PERIOD)
        cart = MechanismPlant(plant, PERIOD)
        state = cart.reset((place, math.pi + tilt), (velocity, 0.0))
        way = [place]
        for _ in range(500):
            state = cart.step(controller.efforts(state.time, state.position, state.velocity))
            way.append(state.position[0])
        assert np.abs(plant.coordinates.deviation(state.position)).max() < 0.02, kind
        farthest[kind] = max(way)
    assert farthest["lqr"] > 1.76
    assert farthest["mpc"] < 1.79
    assert farthest["mpc"] < farthest["lqr"] - 0.02


@pytest.mark.parametrize(("period", "horizon", "enough"), [(0.002, 50, False), (0.005, 50, True), (0.01, 10, False)])
def test_it_says_when_it_looks_less_far_ahead_than_a_pole_falls(period: float, horizon: int, enough: bool) -> None:
    plant = load_mechanism("cart_pole")
    controller = make_controller("mpc", plant, period, {"horizon": horizon})
    assert ("s ahead, and to keep clear of a limit it may let fall" in controller.notice) is not enough
    # Without limits of positions its last cost sees all that comes.
    free = make_controller("mpc", plant, period, {"horizon": horizon, "position_limits": [0.0, 0.0]})
    assert free.notice == ""
    cart = MechanismPlant(plant, period)
    state = cart.reset((1.65, math.pi), (0.3, 0.0))
    for _ in range(round(1.5 / period)):
        state = cart.step(controller.efforts(state.time, state.position, state.velocity))
    assert (abs(plant.coordinates.deviation(state.position)[1]) < 0.5) is enough


def test_a_pole_that_may_not_lean_far_leans_less_far() -> None:
    plant = load_mechanism("cart_pole")
    leaned = []
    for widest in (0.0, 0.03):
        controller = make_controller("mpc", plant, PERIOD, {"position_limits": [0.0, widest]})
        cart = MechanismPlant(plant, PERIOD)
        state, way = cart.reset((0.8, math.pi)), []
        for _ in range(800):
            state = cart.step(controller.efforts(state.time, state.position, state.velocity))
            way.append(abs(state.position[1] - math.pi))
        assert np.abs(plant.coordinates.deviation(state.position)).max() < 0.02
        leaned.append(max(way))
    assert leaned[0] > 0.07
    assert leaned[1] < 0.05


def test_an_effort_that_holds_upright_is_within_the_limits_and_not_on_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = delayed_plant("acrobot_frictionless", PERIOD)
    weighted = replace(linearise(plant), efforts=(2.0,))
    monkeypatch.setattr("pendulum_lqr.controllers.linear_feedback.linearise", lambda *_: weighted)
    controller = make_controller("mpc", plant, PERIOD)
    # At first none is on its way, which is as much too little.
    more = 2.0 * float(controller.gain.K[-1])
    asked = [controller.efforts(0.0, plant.coordinates.goal, (0.0, 0.0))[0] for _ in range(100)]
    assert (asked[0], asked[-1]) == pytest.approx((2.0 + more, 2.0), abs=1e-4)
    limit = plant.effort_limits[0]
    far = [controller.efforts(0.0, near_upright(plant, sign * 0.5, 0.0), (0.0, 0.0))[0] for sign in (-1.0, 1.0)]
    assert sorted(map(abs, far)) == pytest.approx([limit, limit], abs=1e-3)
    assert far[0] * far[1] < 0.0


def test_begun_anew_it_gives_the_same_answers_to_the_last_bit() -> None:
    plant = load_mechanism("cart_pole")
    controller = make_controller("mpc", plant, PERIOD)
    runs = []
    for _ in range(2):
        controller.reset()
        runs.append([controller.efforts(0.0, (1.6 + 0.01 * k, math.pi), (0.5, 0.1)) for k in range(20)])
    assert runs[0] == runs[1]


def test_it_asks_for_no_more_than_each_limit_and_plans_with_it() -> None:
    plant = load_mechanism("cart_pole")
    controller = make_controller("mpc", plant, PERIOD, {"effort_limit": 3.0})
    cart = MechanismPlant(plant, PERIOD)
    state, asked = cart.reset((0.0, math.pi + 0.15)), []
    for _ in range(500):
        asked.append(controller.efforts(state.time, state.position, state.velocity)[0])
        state = cart.step((asked[-1],))
    assert max(map(abs, asked)) == pytest.approx(3.0, abs=1e-3)
    assert max(map(abs, asked)) <= 3.0
    assert np.abs(plant.coordinates.deviation(state.position)).max() < 0.02


def test_what_is_on_its_way_counts() -> None:
    plant = delayed_plant("acrobot_frictionless", 0.015)
    controller = make_controller("mpc", plant, PERIOD)
    model = linearise(plant)
    gain = discrete_lqr(discretise(model, PERIOD), *sampled_cost(model, *plant.mechanism.weights, PERIOD))
    x = np.array([1e-3, 0.0, 0.0, 0.0])
    sent = [0.0, 0.0]
    for _ in range(4):
        effort = controller.efforts(0.0, near_upright(plant, *x[:2]), tuple(x[2:]))[0]
        assert effort == pytest.approx(-float(gain.K @ [*x, *sent]), rel=1e-3, abs=1e-4)
        sent = [sent[1], effort]
    # Designed anew at the same period, it knows what the one before has sent; begun anew, nothing is on its way.
    after = make_controller("mpc", plant, PERIOD, {"q": [20.0, 10.0, 1.0, 1.0]})
    assert isinstance(after, LinearMpc)
    after.carry_over(controller)
    assert list(after.observer._sent) == pytest.approx(sent)
    # At another period it is another time that they take.
    slower = make_controller("mpc", plant, 0.02)
    assert isinstance(slower, LinearMpc)
    slower.carry_over(controller)
    assert list(slower.observer._sent) == [0.0]
    controller.reset()
    assert controller.efforts(0.0, near_upright(plant, *x[:2]), tuple(x[2:]))[0] == pytest.approx(
        -float(gain.K @ [*x, 0.0, 0.0]), rel=1e-3, abs=1e-4
    )


@pytest.mark.parametrize("name", ["acrobot_frictionless", "furuta"])
def test_it_settles_a_plant_with_delay(name: str) -> None:
    plant = delayed_plant(name, 0.012)
    controller = make_controller("mpc", plant, PERIOD)
    simulated = MechanismPlant(plant, PERIOD)
    state = simulated.reset(near_upright(plant, 0.01, -0.01))
    for _ in range(600):
        state = simulated.step(controller.efforts(state.time, state.position, state.velocity))
    assert np.abs(plant.coordinates.deviation(state.position)).max() < 2e-3


def test_where_the_solver_finds_no_plan_the_limited_lqr_answers_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = load_mechanism("cart_pole")
    controller = make_controller("mpc", plant, PERIOD)
    assert isinstance(controller, LinearMpc)
    assert controller.notice == ""
    monkeypatch.setattr(controller._program, "first", lambda *_: None)
    x = np.array([0.01, 0.02, 0.0, 0.0])
    expected = -float(np.atleast_2d(controller.gain.K)[0] @ x)
    assert controller.efforts(0.0, near_upright(plant, *x[:2]), (0.0, 0.0)) == pytest.approx((expected,))
    assert controller.efforts(0.0, near_upright(plant, 0.0, 1.0), (0.0, 0.0)) == (-plant.effort_limits[0],)
    assert controller.notice == "no plan for 2 states: the LQR answered"


@pytest.mark.parametrize("wild", [1e3, 1e12, 1e300])
def test_a_wild_state_leaves_nothing_behind(wild: float) -> None:
    plant = load_mechanism("cart_pole")
    controller, fresh = (make_controller("mpc", plant, PERIOD) for _ in range(2))
    assert controller.efforts(0.0, near_upright(plant, 0.1, 0.1), (wild, -wild)) == (plant.effort_limits[0],)
    assert controller.notice == "no plan for 1 states: the LQR answered"
    for k in range(5):
        state = near_upright(plant, 0.1 * k, 0.1 - 0.02 * k), (0.3, 0.5 - 0.1 * k)
        assert controller.efforts(0.0, *state) == fresh.efforts(0.0, *state)
    assert controller.notice == "no plan for 1 states: the LQR answered"
    assert fresh.notice == ""


def test_what_a_solver_cannot_tell_the_lqr_answers_with_its_signs() -> None:
    plant = load_mechanism("double_pendulum")
    for wild in (1e6, 1e12):
        answers = [
            make_controller(kind, plant, PERIOD).efforts(0.0, plant.coordinates.goal, (wild, -wild))
            for kind in ("discrete_lqr", "mpc")
        ]
        assert answers[0] == answers[1]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_state_that_is_not_finite_is_not_answered(bad: float) -> None:
    loop = ControlLoop(make_controller("mpc", load_mechanism("furuta"), PERIOD), math.inf)
    assert loop.answer(JointSample(1, (0.0, bad), (0.0, 0.0), (0.0, 0.0)), 1) is None
    assert loop.answered == 0


def test_positions_are_limited_where_there_are_end_stops_and_wherever_somebody_says() -> None:
    defaults = {
        name: next(s.default for s in LinearMpc.parameters(load_mechanism(name)) if s.name == "position_limits")
        for name in ("cart_pole", "furuta")
    }
    assert defaults == {"cart_pole": pytest.approx([1.71, 0.0]), "furuta": [0.0, 0.0]}
    # From upright, to the nearer of two stops, or to the only one.
    hinge = load_mechanism("furuta").with_values({"pendulum.lower_stop": 2.5, "pendulum.upper_stop": 4.0})
    track = load_mechanism("cart_pole").with_values({"cart.upper_stop": 1.0})
    for plant, expected in ((hinge, [0.0, 0.95 * (math.pi - 2.5)]), (track, [0.95, 0.0])):
        widths = next(spec.default for spec in LinearMpc.parameters(plant) if spec.name == "position_limits")
        assert widths == pytest.approx(expected)
    with pytest.raises(ParameterError, match=r"position_limits has 1 values; expected 2, for cart, pole"):
        make_controller("mpc", load_mechanism("cart_pole"), PERIOD, {"position_limits": [1.0]})
    told = make_controller("mpc", load_mechanism("cart_pole"), PERIOD, {"position_limits": [0.5, 0.0]})
    assert "positions within [0.5, none]" in told.describe()


@pytest.mark.parametrize("given", [{"position_limits": [1e-200, 0.0]}, {"effort_limit": 1e-300}])
def test_limits_that_no_solver_takes_are_refused_in_words(given: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match=r"limits of efforts \[.*\] and of states \[.*\] .* too far from one"):
        make_controller("mpc", load_mechanism("cart_pole"), PERIOD, given)


def test_another_period_than_that_of_the_design_is_refused() -> None:
    controller = make_controller("mpc", load_mechanism("cart_pole"), PERIOD)
    controller.check(0.0101)
    with pytest.raises(ParameterError, match=r"the loop is predicted every 0\.01 s; expected states at that period"):
        controller.check(0.002)
