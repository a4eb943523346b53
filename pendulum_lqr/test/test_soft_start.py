"""A torque that begins at zero, on a plant that lets nobody begin with much."""

import math

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import controller_names, controller_parameters, make_controller
from pendulum_lqr.controller_interface.interface import unwrapped
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, limits_from_parameters
from pendulum_msgs_py.contract.supervisor import Input, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.stepping.plants import make_pendulum

THESIS = load_plant("thesis")
PERIOD = 0.01


def swing_up(controller, duration):
    """Return angles from upright, torques and the supervisor after a run from hanging with a small first torque."""
    limits = validate(LIMIT_SPECS, {"start_effort_limit": 2.0})
    supervisor = PlantSupervisor(limits_from_parameters(limits, (THESIS.effort_limit,), lockstep=False))
    loop = ControlLoop(controller, math.inf, simulated_time=True)
    plant = make_pendulum(THESIS, PERIOD)
    state = plant.reset(0.0, 0.0)
    now = NANOSECONDS
    assert supervisor.arm(now, JointSample.of_one(now, 0.0, 0.0, 0.0)) == ""
    angles, efforts = [], []
    for _ in range(round(duration / PERIOD)):
        sample = JointSample.of_one(now, state.theta, state.theta_dot, state.effort)
        supervisor.offer(Input.EFFORT_COMMAND, JointCommand(now, loop.answer(sample, now), "controller"), now)
        drive = supervisor.decide(now, sample)
        supervisor.report_applied(drive.effort)
        state = plant.step(drive.effort[0], 0.0)
        angles.append(abs(math.remainder(state.theta - math.pi, 2.0 * math.pi)))
        efforts.append(drive.effort[0])
        now += round(PERIOD * NANOSECONDS)
    return np.array(angles), np.array(efforts), supervisor


@pytest.mark.parametrize(("kind", "duration"), [("energy_swing_up", 10.0), ("time_optimal", 6.0)])
def test_a_swing_up_from_hanging_begins_where_a_first_torque_must_be_small(kind, duration):
    own = make_controller(kind, THESIS, PERIOD, {"start_time": 0.2})
    angles, efforts, supervisor = swing_up(own, duration)
    assert efforts[0] == 0.0
    rising = np.abs(efforts[:20])
    assert np.all(rising <= THESIS.effort_limit * PERIOD * np.arange(20) / 0.2 + 1e-9)
    assert rising[-1] > 0.9 * THESIS.effort_limit  # all that it may have: it pushes at the limit from the first state
    assert supervisor.reason == "commanded by controller"
    assert np.all(angles[-200:] < 0.1)


def test_at_once_it_is_refused_in_words_that_say_what_lets_it_begin():
    angles, efforts, supervisor = swing_up(make_controller("energy_swing_up", THESIS, PERIOD), 0.5)
    assert not efforts.any()
    assert np.all(angles == pytest.approx(math.pi))
    assert "asks for -13.00 N m; expected at most 2.0 N m to begin: bring the plant" in supervisor.reason


@pytest.mark.parametrize("velocity", ["measured", "kalman"])
def test_after_its_start_it_is_the_controller_that_it_was(velocity):
    values = {"velocity": velocity}
    plain = make_controller("lqr", THESIS, PERIOD, values)
    soft = make_controller("lqr", THESIS, PERIOD, {**values, "start_time": 0.3})
    assert type(unwrapped(soft)) is type(unwrapped(plain))
    assert soft.effort_limits == plain.effort_limits
    for _ in range(2):  # a restart begins anew
        for controller in (plain, soft):
            controller.reset()
        rows = np.array([[each.command(PERIOD * k, (0.02, 0.0)) for each in (plain, soft)] for k in range(60)])
        bound = THESIS.effort_limit * np.minimum(1.0, PERIOD * np.arange(60) / 0.3)
        if velocity == "measured":
            np.testing.assert_allclose(rows[:, 1], np.clip(rows[:, 0], -bound, bound))
        assert np.all(np.abs(rows[:, 1]) <= bound + 1e-12)
    # Other gains while it runs: what was remembered goes on, through what is around it.
    lqi = {"start_time": 0.3, "velocity": velocity}
    first, second, fresh = (make_controller("lqi", THESIS, PERIOD, lqi) for _ in range(3))
    for k in range(100):
        last = first.command(PERIOD * k, (0.02, 0.0))
    second.carry_over(first)
    assert second.command(1.0, (0.02, 0.0)) == pytest.approx(last, rel=0.05)
    assert abs(fresh.command(1.0, (0.02, 0.0)) - last) > 0.2 * abs(last)


@pytest.mark.parametrize("kind", controller_names())
def test_every_controller_has_one_start_time(kind):
    found = [spec.default for spec in controller_parameters(kind) if spec.name == "start_time"]
    assert found == [0.2 if kind == "policy" else 0.0]
