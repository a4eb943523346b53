"""Controllers on the series-elastic plant, with lag, delay, offsets and constant torques: designed for what runs."""

import math

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.loop_check import growth
from pendulum_lqr.disturbances.disturbance import make_disturbance
from pendulum_lqr.linear.design import DesignError
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant, pendulum_plant

THESIS = load_plant("thesis")
DFKI = load_plant("dfki")
X5_9 = load_plant("x5_9")
LATE = X5_9.with_values(transport_delay=0.013, actuator_time_constant=0.02)
ELASTIC = ("lqr", "lqi", "lqg", "lqr_friction", "mpc", "pid", "pd_gravity")
RIGID_ONLY = ("discrete_lqr", "sliding_mode", "energy_swing_up", "time_optimal", "tvlqr", "nmpc")
STICKS = 0.39 / 1.526
"""Command that the dry friction of the X5-9's motor swallows [N m]."""


@pytest.mark.parametrize("plant", [X5_9, LATE], ids=["x5_9", "x5_9 with lag and delay"])
@pytest.mark.parametrize("name", ELASTIC)
def test_every_controller_that_takes_a_series_elastic_plant_brings_it_to_rest_at_upright(name, plant, simulate):
    controller = make_controller(name, plant, 0.01)
    run = simulate(plant, controller, theta=UPRIGHT + 0.2, duration=6.0)
    # At rest, not in a limit cycle, and no farther off than friction can hold it against the controller's stiffness.
    assert np.ptp(run.angle[-100:]) < 1e-3
    assert abs(run.angle[-1]) < STICKS / 25.0
    assert np.max(np.abs(run.effort)) < 13.0


@pytest.mark.parametrize("name", RIGID_ONLY)
def test_a_controller_for_rigid_plants_refuses_a_series_elastic_one_and_names_others(name):
    with pytest.raises(ParameterError, match=r"plant 'x5_9' is series elastic.*expected .*(lqr|lqg)"):
        make_controller(name, X5_9, 0.01)


@pytest.mark.parametrize("plant", [THESIS, X5_9, LATE, DFKI.with_values(transport_delay=0.03)])
@pytest.mark.parametrize("name", ["lqg", "mpc"])
def test_observing_a_constant_torque_leaves_no_offset(name, plant, simulate):
    load = make_disturbance({"kind": "step", "amplitude": 0.8})
    rest = {}
    for noise in (0.0, 1.0):
        controller = make_controller(name, plant, 0.01, {"offset_noise": noise})
        run = simulate(plant, controller, theta=UPRIGHT, duration=8.0, disturbance=load)
        rest[noise] = abs(run.angle[-1])
    assert rest[0.0] > 0.01
    assert rest[1.0] < 1e-3


@pytest.mark.parametrize("name", ["lqg", "mpc", "discrete_lqr"])
def test_a_delay_that_makes_plain_feedback_unstable_is_reckoned_with(name, simulate):
    delayed = DFKI.with_values(transport_delay=0.06, effort_limit=10.0, coulomb_friction=0.0, static_friction=0.0)
    with pytest.raises(DesignError, match=r"lqr makes the loop unstable .* a delay of 0\.06 s"):
        make_controller("lqr", delayed, 0.01)
    run = simulate(delayed, make_controller(name, delayed, 0.01), theta=UPRIGHT + 0.1, duration=5.0)
    assert np.max(np.abs(run.angle[-100:])) < 1e-3


@pytest.mark.parametrize("name", ["lqg", "mpc", "discrete_lqr"])
def test_a_lag_is_a_state_and_not_forgotten(name, simulate):
    lagging = DFKI.with_values(actuator_time_constant=0.1, effort_limit=10.0, coulomb_friction=0.0, static_friction=0.0)
    run = simulate(lagging, make_controller(name, lagging, 0.01), theta=UPRIGHT + 0.05, duration=5.0)
    assert np.max(np.abs(run.angle[-100:])) < 1e-3
    believed = make_controller(name, lagging.with_values(actuator_time_constant=0.0), 0.01)
    assert growth(believed, lagging, 0.01) > 1.0


@pytest.mark.parametrize("feedforward", [True, False])
@pytest.mark.parametrize("name", ["lqg", "discrete_lqr", "mpc"])
def test_the_prediction_knows_the_torque_that_holds_whether_it_is_fed_forward_or_not(name, feedforward, simulate):
    plant = THESIS.with_values(transport_delay=0.02)
    values = {"set_point": 0.6, "feedforward": feedforward}
    run = simulate(plant, make_controller(name, plant, 0.01, values), theta=UPRIGHT + 0.6, duration=8.0)
    hold = plant.gravity * math.sin(0.6)
    gain = make_controller(name, plant, 0.01, {"set_point": 0.6}).gain.K
    # Without the feedforward the loop gives way by what its gains at rest ask for, and by nothing else.
    expected = 0.6
    if not feedforward:
        expected += hold / (gain[0] * 1.0 - plant.gravity * math.cos(0.6) * (1.0 + sum(gain[2:])))
    assert run.angle[-1] == pytest.approx(expected, abs=2e-3)


def test_ki_and_filters_survive_a_change_of_where_the_velocity_comes_from(simulate):
    load = make_disturbance({"kind": "step", "amplitude": 1.0})
    for name in ("lqi", "pid"):
        for before, after in (("kalman", "measured"), ("measured", "kalman"), ("kalman", "filtered_difference")):
            first = make_controller(name, THESIS, 0.01, {"velocity": before})
            simulate(THESIS, first, theta=UPRIGHT, duration=15.0, disturbance=load)
            second = make_controller(name, THESIS, 0.01, {"velocity": after})
            second.carry_over(first)
            assert second.command(15.0, (0.0, 0.0)) == pytest.approx(-1.0, abs=0.01), (name, before, after)


def test_a_swing_up_that_balances_goes_on_balancing_after_a_change_of_parameters(simulate):
    first = make_controller("energy_swing_up", DFKI, 0.01)
    simulate(DFKI, first, theta=UPRIGHT, duration=1.0)
    second = make_controller("energy_swing_up", DFKI, 0.01, {"gain": 40.0})
    second.carry_over(first)
    assert second.catch.active


@pytest.mark.parametrize("name", ["lqr", "lqi", "lqg", "discrete_lqr", "pid", "pd_gravity", "mpc", "sliding_mode"])
def test_every_balancing_controller_rests_at_its_set_point_on_a_plant_with_offsets(name, simulate):
    plant = THESIS.with_values(angle_offset=-0.3, torque_offset=0.3)
    controller = make_controller(name, plant, 0.01, {"set_point": 0.2})
    run = simulate(plant, controller, theta=UPRIGHT, duration=8.0)
    assert run.angle[-1] == pytest.approx(0.2, abs=2e-3)


OFFSETS = [
    ({"angle_offset": 0.3}, 0.0),
    ({"angle_offset": -0.1, "torque_offset": 0.2}, 0.1),
    ({}, -0.3),
]
SWING_UPS = {"energy_swing_up": {}, "time_optimal": {"grid": 200}, "tvlqr": {"nodes": 60}}


# An answer of nmpc takes milliseconds: it starts once, where there is an offset of each kind and a set point.
@pytest.mark.parametrize(
    ("name", "values", "offsets", "set_point"),
    [
        *((name, values, *each) for name, values in SWING_UPS.items() for each in OFFSETS),
        ("nmpc", {}, *OFFSETS[1]),
    ],
)
def test_every_swing_up_ends_at_its_set_point_on_a_plant_with_offsets(name, values, offsets, set_point, simulate):
    plant = DFKI.with_values(**offsets)
    controller = make_controller(name, plant, 0.01, {**values, "set_point": set_point})
    # Energy is pumped in slowly.
    run = simulate(plant, controller, theta=plant.angle_offset, duration=5.0 if name == "nmpc" else 9.0)
    # Dry friction holds it off by at most its torque over the stiffness of the catch.
    assert np.max(np.abs(run.angle[-100:] - set_point)) < 0.02


@pytest.mark.parametrize("start", [0.2, -0.2, 0.0, 1.0, 3.0])
def test_energy_swing_up_breaks_away_wherever_dry_friction_holds_it(start, simulate):
    sticky = pendulum_plant(
        inertia=0.055, damping=0.05, gravity=1.678, coulomb_friction=0.3, static_friction=0.39, effort_limit=1.2
    )
    run = simulate(sticky, make_controller("energy_swing_up", sticky, 0.01), theta=start, duration=6.0)
    assert run.swing_up_time < 4.0
    assert np.max(np.abs(run.angle[-50:])) < 0.1


def test_energy_swing_up_refuses_a_limit_below_what_friction_holds():
    stuck = DFKI.with_values(coulomb_friction=0.5, static_friction=0.8, effort_limit=0.7)
    with pytest.raises(DesignError, match=r"effort_limit is 0\.7 N m; expected more than static friction .*0\.8 N m"):
        make_controller("energy_swing_up", stuck, 0.01)


@pytest.mark.parametrize("name", ["energy_swing_up", "time_optimal", "tvlqr", "nmpc"])
def test_weights_whose_catch_can_never_engage_are_refused(name):
    told = r"no region around the set-point is proven to be caught with catch_q = \[100"
    with pytest.raises(DesignError, match=told):
        make_controller(name, THESIS, 0.01, {"catch_q": [100.0, 0.0]})


def test_a_trajectory_goes_on_while_states_are_not_answered(simulate):
    controller = make_controller("tvlqr", DFKI, 0.01, {"nodes": 60})
    x = (-math.pi, 0.0)
    controller.command(0.0, x)
    first = controller._index
    controller.command(0.01, x)
    assert controller._index == first + 1
    controller.command(0.06, x)
    assert controller._index == first + 6


def test_sliding_mode_gives_way_to_a_constant_torque_by_what_its_layer_says(simulate):
    load = make_disturbance({"kind": "step", "amplitude": 0.8})
    controller = make_controller("sliding_mode", THESIS, 0.01)
    run = simulate(THESIS, controller, theta=UPRIGHT, duration=8.0, disturbance=load)
    rate, gain, layer = controller.rate, controller.gain, controller.layer
    assert run.angle[-1] == pytest.approx(0.8 / (rate * (THESIS.damping + gain / layer)), rel=1e-3)


@pytest.mark.parametrize(
    ("plant", "values"),
    [(X5_9, {"bandwidth": 15.0}), (THESIS, {"kp": 9000.0}), (DFKI.with_values(transport_delay=0.2), {})],
)
def test_gains_that_make_the_loop_unstable_are_refused_with_what_would_help(plant, values):
    told = "pd_gravity makes the loop unstable with a period of .*expected a shorter period"
    with pytest.raises(DesignError, match=told):
        make_controller("pd_gravity", plant, 0.01, values)


@pytest.mark.parametrize("velocity", ["kalman", "filtered_difference", "savitzky_golay"])
def test_an_estimated_velocity_balances_the_series_elastic_plant(velocity, simulate):
    controller = make_controller("lqr", LATE, 0.01, {"velocity": velocity})
    run = simulate(LATE, controller, theta=UPRIGHT + 0.1, duration=5.0)
    assert np.ptp(run.angle[-50:]) < 1e-3
    assert abs(run.angle[-1]) < 0.015
