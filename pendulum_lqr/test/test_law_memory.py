"""What laws remember, beside the equations that they stand for, and from one design to the next."""

import random

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.plants.plant_parameters import load_plant

PERIOD = 0.005


def plant(*, lag: float = 0.0, torque_offset: float = 0.0):
    return load_plant("thesis").with_values(actuator_time_constant=lag, torque_offset=torque_offset)


def discrete(delay: float, *, lag: float = 0.0, torque_offset: float = 0.0):
    return make_controller("discrete_lqr", plant(lag=lag, torque_offset=torque_offset), PERIOD, {"delay": delay})


@pytest.mark.parametrize("lag", [0.0, 0.02])
@pytest.mark.parametrize("delay", [0.0, 0.003, 0.01, 0.0127])
def test_discrete_lqr_feeds_back_the_state_of_its_model_limits_included(delay: float, lag: float) -> None:
    controller, offset = discrete(delay, lag=lag, torque_offset=0.3), 0.3
    model = discretise(linearise(plant(lag=lag, torque_offset=offset), UPRIGHT), PERIOD, delay)
    hold, limit = controller.hold, controller.effort_limit
    hidden = np.full(model.A.shape[0] - 2, -hold)
    generator, saturated = random.Random(1), 0
    for step in range(60):
        x = np.array([generator.gauss(0.0, 0.5), generator.gauss(0.0, 0.3)])
        z = np.concatenate([x, hidden])
        effort = np.clip(hold - controller.gain.K @ z, -limit, limit).item()
        saturated += abs(effort) == limit
        assert controller.command(step * PERIOD, tuple(x)) == pytest.approx(effort, abs=1e-9)
        hidden = (model.A @ z + model.B[:, 0] * (effort - hold))[2:]
    assert 0 < saturated < 60


@pytest.mark.parametrize("delay", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("lag", [0.0, 0.02])
def test_discrete_lqr_designed_anew_knows_which_torques_are_on_their_way(delay: float, lag: float) -> None:
    before, after = discrete(0.01, lag=lag, torque_offset=0.3), discrete(delay, lag=lag, torque_offset=-0.5)
    sent = [before.command(step * PERIOD, (0.02 * step, 0.1)) for step in range(6)]
    lagged = before.memory[0] + before.hold
    after.carry_over(before)
    on_their_way = [value + after.hold for value in after.memory[1:]]
    kept = min(2, len(on_their_way))
    assert on_their_way[-kept:] == pytest.approx(sent[-kept:])
    # What nobody has sent is none.
    assert on_their_way[:-kept] == pytest.approx([0.0] * (len(on_their_way) - kept))
    if lag:
        assert after.memory[0] + after.hold == pytest.approx(lagged)


def test_a_lag_that_was_not_there_begins_at_no_torque_and_a_state_that_is_no_number_spoils_none() -> None:
    before, after = discrete(0.0, torque_offset=0.3), discrete(0.0, lag=0.02, torque_offset=-0.5)
    answers = [before.command(0.0, (angle, 0.0)) for angle in (0.01, float("nan"), 0.01)]
    assert answers[2] == answers[0]
    after.carry_over(before)
    assert after.memory[0] + after.hold == pytest.approx(0.0)


def test_the_integral_of_lqi_stands_still_at_the_limit() -> None:
    controller = make_controller("lqi", plant(), PERIOD, {"effort_limit": 0.5})
    for step in range(1000):
        assert abs(controller.command(step * PERIOD, (0.3, 0.0))) == 0.5
    assert abs(controller.memory[0]) < 0.3 * PERIOD
    after = make_controller("lqi", plant(), PERIOD, {"q_integral": 900.0})
    controller.memory[0] = 0.02
    after.carry_over(controller)
    assert after.gain.K[2] * after.memory[0] == pytest.approx(controller.gain.K[2] * 0.02)


@pytest.mark.parametrize("name", ["lqi", "pid", "discrete_lqr"])
def test_a_reset_forgets_everything(name: str) -> None:
    controller = make_controller(name, plant(lag=0.02, torque_offset=0.3), PERIOD)
    first, second = ([controller.command(k * PERIOD, (0.01 * k, 0.1)) for k in range(5)] for _ in range(2))
    assert second != first
    controller.reset()
    assert [controller.command(k * PERIOD, (0.01 * k, 0.1)) for k in range(5)] == first
