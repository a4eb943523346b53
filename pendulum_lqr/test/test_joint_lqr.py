"""The LQR of several joints as the controller node runs it."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
import scipy.linalg

from pendulum_lqr.controller_interface.controller import controller_class, make_controller
from pendulum_lqr.linear.design import DesignError, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.joint_plants import lagging_plant

PLANTS = ("acrobot_frictionless", "pendubot_frictionless", "double_pendulum", "cart_pole", "furuta")


@pytest.mark.parametrize("name", PLANTS)
def test_it_answers_with_the_law_within_each_limit_whatever_turns_were_made(name: str) -> None:
    plant = load_mechanism(name)
    controller = make_controller("lqr", plant, 0.01, checked=False)
    model = linearise(plant)
    K = output_lqr(model, *plant.mechanism.weights).rows
    x = np.array([1e-3, -2e-3, 3e-3, 1e-3])
    joints = plant.coordinates.joints
    upright = zip(joints, plant.coordinates.goal, x[:2], strict=True)
    turned = [goal + dq + 2.0 * math.pi * joint.turns for joint, goal, dq in upright]
    limits = np.array(plant.effort_limits)
    expected = np.clip(np.array(model.efforts) - K @ x, -limits, limits)
    loop = ControlLoop(controller, math.inf, simulated_time=True)
    assert loop.answer(JointSample(1, tuple(turned), (3e-3, 1e-3), (0.0, 0.0)), 1) == pytest.approx(expected, rel=1e-6)
    far = loop.answer(JointSample(2, (2.0, 1.0), (50.0, 50.0), (0.0, 0.0)), 2)
    assert np.all(np.abs(far) <= limits)
    assert loop.saturated == 1


@pytest.mark.parametrize("name", PLANTS)
def test_sampled_it_brings_the_plant_upright(name: str) -> None:
    parameters = load_mechanism(name)
    plant = MechanismPlant(parameters, 2e-3)
    controller = make_controller("lqr", parameters, 2e-3)
    state = plant.reset(tuple(goal + 0.02 for goal in parameters.coordinates.goal))
    for _ in range(1500):
        state = plant.step(controller.efforts(state.time, state.position, state.velocity))
    assert np.abs(parameters.coordinates.deviation(state.position)).max() < 0.025


def test_a_period_at_which_it_does_not_settle_is_refused() -> None:
    acrobot = load_mechanism("acrobot_frictionless")
    with pytest.raises(ParameterError, match=r"lqr asked every 0.2 s does not settle on plant 'acrobot_frictionless'"):
        make_controller("lqr", acrobot, 0.2)


@pytest.mark.parametrize("name", ["lqr", "lqi"])
@pytest.mark.parametrize(("period", "lag"), [(0.01, 0.0), (0.002, 0.02)])
def test_it_is_refused_where_the_sampled_loop_with_lag_and_delay_grows_and_nowhere_else(
    name: str, period: float, lag: float
) -> None:
    refused = []
    for delay in np.linspace(0.0, 0.05, 6):
        plant = lagging_plant(load_mechanism("furuta"), lag).with_values({"arm.transport_delay": float(delay)})
        kind = controller_class(name, plant)
        loop = kind.design(plant, period, validate(kind.parameters(plant), {"effort_limit": 0.0}))
        # The law itself around the sampled plant, from a small deviation on, and no limit in the way.
        loop.effort_limits = (math.inf,)
        sampled, goal = discretise(linearise(plant), period), plant.coordinates.goal
        z = 1e-9 * np.eye(sampled.A.shape[0])[1]
        sizes = []
        for _ in range(round(6.0 / period)):
            u = loop.efforts(0.0, (goal[0] + float(z[0]), goal[1] + float(z[1])), (float(z[2]), float(z[3])))
            z = sampled.A @ z + sampled.B @ u
            sizes.append(float(np.abs(z[:4]).max()))
            if sizes[-1] > 1e-3:
                break
        refused.append(True)
        with contextlib.suppress(DesignError):
            make_controller(name, plant, period)
            refused[-1] = False
        assert refused[-1] == (sizes[-1] > 1e-3)
    assert set(refused) == {True, False}


def test_a_swing_up_wants_a_plant_for_which_one_is_stored_and_the_period_of_its_design() -> None:
    swing_up = make_controller("tvlqr", load_mechanism("acrobot_frictionless"), 0.01, checked=False)
    with pytest.raises(ParameterError, match=r"the trajectory is followed every 0\.01 s"):
        swing_up.check(0.002)
    with pytest.raises(ParameterError, match="no swing-up is stored for plant 'furuta'"):
        make_controller("tvlqr", load_mechanism("furuta"), 0.002)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_state_that_is_not_finite_at_any_joint_is_not_answered(bad: float) -> None:
    loop = ControlLoop(make_controller("lqr", load_mechanism("cart_pole"), 0.01, checked=False), math.inf)
    assert loop.answer(JointSample(1, (0.0, bad), (0.0, 0.0), (0.0, 0.0)), 1) is None
    assert loop.answer(JointSample(1, (0.0, 0.0), (bad, 0.0), (0.0, 0.0)), 1) is None
    assert loop.answered == 0


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013])
def test_a_model_of_two_inputs_is_sampled_as_two_models_of_one(delay: float) -> None:
    model = linearise(load_mechanism("double_pendulum"))
    whole = discretise(model, 0.01, delay)
    rng = np.random.default_rng(3)
    inputs = rng.normal(size=(6, 2))
    z = np.zeros(whole.A.shape[0])
    for u in inputs:
        z = whole.A @ z + whole.B @ u
    # The exact solution under held inputs, each of which begins to act after the delay.
    x, h = np.zeros(4), 1e-3
    step = scipy.linalg.expm(np.block([[model.A, model.B], [np.zeros((2, 6))]]) * h)
    for k in range(60):
        index = math.floor((k * h - delay) / 0.01 + 1e-9)
        x = (step @ np.concatenate([x, inputs[index] if index >= 0 else np.zeros(2)]))[:4]
    assert z[:4] == pytest.approx(x, rel=1e-9, abs=1e-12)


def test_no_effort_is_made_of_a_law_that_has_no_number() -> None:
    controller = make_controller("lqr", load_mechanism("cart_pole"), 0.01, checked=False)
    answering = ControlLoop(controller, math.inf)
    # Finite velocities whose terms are inf and -inf.
    first, second = (math.copysign(1e308, float(k)) for k in controller.gain.K[2:])
    assert answering.answer(JointSample(1, (0.0, 0.0), (first, -second), (0.0, 0.0)), 1) is None
    assert answering.last_reason == "controller answered nan"
