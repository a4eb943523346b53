"""The law that swings a pendulum up by its energy: what it accelerates, within which limits, and whom it refuses."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pendulum_lqr.controllers.joint_energy_swing_up import JointEnergySwingUp, _bounded
from pendulum_lqr.linear.design import DesignError, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.swing_up.catch import CaughtRegion, MechanismCatch
from pendulum_lqr.swing_up.pump import EnergyPump, PumpGains, pump_gains
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

NAMES = ("cart_pole", "furuta", "pendubot_frictionless")
PLANTS = {name: load_mechanism(name) for name in NAMES}
FREE = {
    name: plant.with_values({f"{joint}.damping": 0.0 for joint in plant.coordinates.names})
    for name, plant in PLANTS.items()
}
STRONG = 1e9
"""A motor that no acceleration saturates [N m or N]."""
angles, speeds = st.floats(-10.0, 10.0), st.floats(-30.0, 30.0)


def _pump(plant: PlantParameters, limit: float | None = None, **changes: float) -> EnergyPump:
    return EnergyPump(plant, replace(pump_gains(plant), **changes), limit or plant.effort_limits[0])


def _controller(plant: PlantParameters) -> JointEnergySwingUp:
    """Return a controller whose LQR catches from next to upright: nothing is sampled."""
    gain = output_lqr(linearise(plant), *plant.mechanism.weights)
    return JointEnergySwingUp(plant, _pump(plant), 0.01, MechanismCatch(plant, gain, CaughtRegion(1e-4, 1)))


def _accelerations(plant: PlantParameters, pump: EnergyPump, position: Vector, velocity: Vector, margin: float):
    """Return what the law does to both joints, by the mechanism's own equations, which have no dry friction."""
    effort = plant.coordinates.spread((pump.effort(position, velocity, margin),))
    return plant.mechanism.forward(position, velocity, effort, plant.packed)


def _states(plant: PlantParameters, gains: PumpGains, angle: float, speed: float) -> tuple[Vector, Vector]:
    """Return a state with the driven joint at rest at its goal: the pendulum so far from upright, so fast."""
    driven = plant.coordinates.driven[0]
    position, velocity = list(plant.coordinates.goal), [0.0, 0.0]
    position[1 - driven] += angle
    velocity[1 - driven] = speed
    return tuple(position), tuple(velocity)


@pytest.mark.parametrize("name", NAMES)
@given(position=st.tuples(angles, angles), velocity=st.tuples(speeds, speeds), margin=st.floats(-0.2, 1.0))
def test_no_state_asks_for_more_than_the_limit_whatever_it_is(
    name: str, position: Vector, velocity: Vector, margin: float
) -> None:
    pump = _pump(PLANTS[name], 0.7 * PLANTS[name].effort_limits[0])
    assert abs(pump.effort(position, velocity, margin)) <= 0.7 * PLANTS[name].effort_limits[0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("place", range(4))
def test_what_is_no_number_is_answered_by_none_so_that_it_is_refused_and_forgotten(name: str, place: int) -> None:
    plant = PLANTS[name]
    controller = _controller(plant)
    state = [0.3, 0.2, 0.1, -0.2]
    before = controller.efforts(0.0, tuple(state[:2]), tuple(state[2:]))
    broken = [*state]
    broken[place] = math.nan
    assert math.isnan(controller.efforts(0.01, tuple(broken[:2]), tuple(broken[2:]))[0])
    assert not controller.catch.active
    assert controller.margin.value == 0.01
    assert controller.efforts(0.02, tuple(state[:2]), tuple(state[2:])) == before


@pytest.mark.parametrize("name", NAMES)
@given(angle=st.floats(-3.0, 3.0), speed=st.floats(-12.0, 12.0), margin=st.floats(-0.2, 0.5))
def test_energy_goes_in_below_what_is_aimed_at_and_out_above_by_the_law_as_it_is_written(
    name: str, angle: float, speed: float, margin: float
) -> None:
    plant = FREE[name]
    pump = _pump(plant, STRONG)
    gains = pump_gains(plant)
    driven = plant.coordinates.driven[0]
    position, velocity = _states(plant, gains, angle, speed)
    share = pump.share(position, velocity)
    accelerated = _accelerations(plant, pump, position, velocity, margin)[driven]
    hanging = list(plant.coordinates.goal)
    hanging[1 - driven] += math.pi
    lowest, here = (plant.mechanism.mass(tuple(q), plant.packed) for q in (hanging, position))
    top = plant.energy(plant.coordinates.goal, (0.0, 0.0)) - plant.energy(tuple(hanging), (0.0, 0.0))
    inertia = lowest[1 - driven][1 - driven]
    frequency = math.sqrt(0.5 * top / inertia)
    coupled, couples = (
        rows[1 - driven][driven] - gains.carried * rows[1 - driven][1 - driven] for rows in (lowest, here)
    )
    wanted = gains.gain * frequency * inertia / coupled**2 * (share - 1.0 - margin) * couples * speed
    pushed = 0.05 * frequency**2 * inertia / abs(coupled) if share < 0.05 and abs(speed) < 0.01 * frequency else 0.0
    assert abs(accelerated - wanted) <= pushed + 1e-6 * (1.0 + abs(wanted))
    done = -couples * speed * accelerated
    assert done * (1.0 + margin - share) >= -1e-6


@pytest.mark.parametrize("name", NAMES)
@given(error=st.floats(-0.9, 0.9), speed=st.floats(-1.5, 1.5))
def test_the_driven_joint_comes_back_as_a_spring_and_a_damper_would_bring_it(
    name: str, error: float, speed: float
) -> None:
    plant = FREE[name]
    gains = replace(pump_gains(plant), servo=0.7, damping=0.4, reach=0.0)
    pump = EnergyPump(plant, gains, STRONG)
    driven = plant.coordinates.driven[0]
    goal = plant.coordinates.goal
    position, velocity = list(goal), [0.0, 0.0]
    # The pendulum stands still at upright, whatever carries its frame along: nothing is pumped.
    position[driven] += error
    position[1 - driven] -= gains.carried * error
    velocity[driven] = speed
    velocity[1 - driven] = -gains.carried * speed
    hanging = list(goal)
    hanging[1 - driven] += math.pi
    inertia = plant.mechanism.mass(tuple(hanging), plant.packed)[1 - driven][1 - driven]
    top = plant.energy(goal, (0.0, 0.0)) - plant.energy(tuple(hanging), (0.0, 0.0))
    servo = 0.7 * math.sqrt(0.5 * top / inertia)
    found = _accelerations(plant, pump, tuple(position), tuple(velocity), 0.0)[driven]
    assert found == pytest.approx(-(servo**2) * error - 0.8 * servo * speed, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("name", NAMES)
@given(angle=st.floats(-3.0, 3.0), speed=st.floats(-12.0, 12.0))
def test_energy_counts_from_hanging_at_0_to_upright_at_1_however_the_driven_joint_is_turned(
    name: str, angle: float, speed: float
) -> None:
    plant = PLANTS[name]
    pump, gains = _pump(plant), pump_gains(plant)
    driven = plant.coordinates.driven[0]
    for turned in (0.0, 0.4):
        position, velocity = (list(each) for each in _states(plant, gains, angle, speed))
        position[driven] += turned
        position[1 - driven] -= gains.carried * turned
        share = pump.share(tuple(position), tuple(velocity))
        hanging = list(plant.coordinates.goal)
        hanging[1 - driven] += math.pi
        low, top = (plant.energy(q, (0.0, 0.0)) for q in (tuple(hanging), plant.coordinates.goal))
        own = plant.energy(*_states(plant, gains, angle, speed))
        assert share == pytest.approx((own - low) / (top - low), rel=1e-9, abs=1e-9)
        found, rate = pump.swing(tuple(position), tuple(velocity))
        assert abs(wrap(found - angle)) < 1e-9
        assert rate == speed


def test_it_makes_up_for_damping_and_dry_friction_as_far_as_the_hinge_moves_the_pendulum() -> None:
    plant = FREE["cart_pole"]
    rough = plant.with_values({"pole.damping": 0.002, "pole.coulomb_friction": 0.004})
    for angle, speed, share_of_dry in (
        (3.0, 4.0, 1.0),
        (3.0, -4.0, -1.0),
        (3.0, 0.1, 0.1 / (0.05 * 3.8360)),
        (1.5, 4.0, 1.0),
    ):
        position, velocity = (0.0, math.pi + angle), (0.0, speed)
        pumps = [_pump(each, STRONG) for each in (plant, rough)]
        smooth = _accelerations(plant, pumps[0], position, velocity, 0.0)[0]
        # By the rough plant's equations: damping acts there, and dry friction beside them.
        made_up = _accelerations(rough, pumps[1], position, velocity, 0.0)[0]
        coupling = 0.05 * math.cos(position[1])
        lost = 0.002 * speed + 0.004 * share_of_dry
        assert made_up - smooth == pytest.approx(-lost * coupling / max(coupling**2, (0.3 * 0.05) ** 2), rel=2e-3)


def test_the_motors_own_dry_friction_is_added_in_the_way_that_the_joint_goes_or_should() -> None:
    plant = FREE["cart_pole"].with_values({"cart.coulomb_friction": 0.5})
    plain, rough = _pump(FREE["cart_pole"], STRONG), _pump(plant, STRONG)
    for position, velocity, way in (
        ((0.3, 0.5), (0.4, 2.0), 1.0),
        ((0.3, 0.5), (-0.4, 2.0), -1.0),
        ((-0.3, math.pi), (-0.01, 0.0), -1.0),
        ((0.3, math.pi), (0.0, 0.0), -1.0),
        ((-0.3, math.pi), (0.0, 0.0), 1.0),
    ):
        assert rough.effort(position, velocity, 0.0) - plain.effort(position, velocity, 0.0) == pytest.approx(0.5 * way)


def test_a_pendulum_that_hangs_still_is_pushed_and_one_that_swings_or_stands_is_not() -> None:
    plant = FREE["cart_pole"]
    pump = _pump(plant, STRONG)
    frequency = math.sqrt(0.4905 / 0.0333333)
    push = 0.05 * frequency**2 * 0.0333333 / 0.05
    hanging = _accelerations(plant, pump, (0.0, 0.0), (0.0, 0.0), 0.0)[0]
    assert hanging == pytest.approx(-push, rel=1e-4)
    assert _accelerations(plant, pump, (0.0, 0.0), (0.0, -1e-6), 0.0)[0] == pytest.approx(push, rel=1e-4)
    assert _accelerations(plant, pump, (0.0, math.pi), (0.0, 0.0), 0.0)[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(_accelerations(plant, pump, (0.0, 0.0), (0.0, 0.011 * frequency), 0.0)[0]) < 0.5 * push
    assert _accelerations(plant, pump, (0.0, 0.0), (0.0, -0.009 * frequency), 0.0)[0] > push
    # More where the pendulum sticks: twice what holds it.
    stuck = plant.with_values({"pole.coulomb_friction": 0.004})
    assert _accelerations(stuck, _pump(stuck, STRONG), (0.0, 0.0), (0.0, 0.0), 0.0)[0] == pytest.approx(
        -push - 2.0 * 0.004 / 0.05, rel=1e-4
    )


@given(room=st.floats(0.001, 3.0), speed=st.floats(0.0, 5.0), side=st.sampled_from([-1.0, 1.0]))
@example(room=1.0, speed=3.7, side=1.0)  # more than six tenths of the motor, less than all of it
def test_it_brakes_where_its_motor_would_else_not_stop_it_in_time(room: float, speed: float, side: float) -> None:
    pump = _pump(FREE["cart_pole"])
    # Six tenths of 10 N on cart and pole: least where the pole is level, 1.1 kg.
    brakes = 0.6 * 10.0 / 1.1
    position = (side * (pump.reach - room), math.pi / 2.0)
    free = _pump(FREE["cart_pole"], reach=0.0)
    free.reach = math.inf
    velocity = (side * speed, 0.0)
    found = _accelerations(FREE["cart_pole"], pump, position, velocity, 0.0)[0] * side
    unbound = _accelerations(FREE["cart_pole"], free, position, velocity, 0.0)[0] * side
    if speed and 0.5 * speed**2 > 1.001 * brakes * room:
        # As much as it takes, or as the motor has.
        assert found == pytest.approx(max(min(unbound, -0.5 * speed**2 / room), -10.0 / 1.1))
    elif 0.5 * speed**2 < 0.999 * brakes * room:
        assert found == pytest.approx(unbound)


def test_beyond_its_reach_it_brakes_while_it_goes_on_and_comes_back() -> None:
    plant = FREE["cart_pole"]
    pump = _pump(plant)
    for side in (-1.0, 1.0):
        for speed, beyond in ((0.0, 0.1), (0.2, 0.1), (0.2, 0.0)):
            position = (side * (pump.reach + beyond), math.pi / 2.0)
            going = _accelerations(plant, pump, position, (side * speed, 0.0), 0.0)[0]
            assert going * side < 0.0
            if speed:
                assert going * side == pytest.approx(-0.6 * 10.0 / 1.1, rel=1e-6)
    back = _accelerations(plant, pump, (pump.reach + 0.1, math.pi / 2.0), (-0.5, 0.0), 0.0)[0]
    assert back < 0.5


def test_its_reach_is_the_smaller_of_what_is_asked_for_and_nine_tenths_of_the_way_to_the_nearer_stop() -> None:
    plant = PLANTS["cart_pole"]
    assert _pump(plant).reach == pytest.approx(1.62)
    assert _pump(plant, reach=5.0).reach == pytest.approx(1.62)
    assert _pump(plant, reach=0.7).reach == 0.7
    assert _pump(plant.with_values({"cart.upper_stop": 1.0})).reach == pytest.approx(0.9)
    assert _pump(plant.with_values({"cart.lower_stop": -1.0})).reach == pytest.approx(0.9)
    assert _pump(PLANTS["furuta"], reach=0.0).reach == math.inf
    # About a goal that is not 0: shoulder upright, at pi.
    shoulder = PLANTS["pendubot_frictionless"].with_values({"shoulder.lower_stop": 0.0, "shoulder.upper_stop": 4.0})
    assert _pump(shoulder, reach=0.0).reach == pytest.approx(0.9 * (4.0 - math.pi))


@pytest.mark.parametrize(("name", "joint", "weight"), [
    ("pendubot_frictionless", "elbow", 1.56914), ("cart_pole", "pole", 0.4905), ("furuta", "pendulum", 0.0151859),
])  # fmt: skip
def test_more_dry_friction_of_the_pendulum_than_its_lqr_brings_to_rest_is_refused(
    name: str, joint: str, weight: float
) -> None:
    friction = f"{joint}.coulomb_friction"
    assert _pump(PLANTS[name].with_values({friction: 0.0149 * weight})).reach > 0.0
    with pytest.raises(DesignError, match=rf"no dry friction, and {joint} of plant '{name}' is passive with .*at most"):
        _pump(PLANTS[name].with_values({friction: 0.0151 * weight}))


def test_the_pendubot_as_it_was_measured_is_refused_and_its_frictionless_twin_named() -> None:
    with pytest.raises(DesignError, match=r"elbow of plant 'pendubot' is passive with 0\.12 N m; .* frictionless twin"):
        _pump(load_mechanism("pendubot"))


def test_a_pendulum_whose_frame_is_carried_swings_with_both_velocities() -> None:
    plant = FREE["pendubot_frictionless"]
    pump, gains = _pump(plant, STRONG), pump_gains(plant)
    position = (math.pi, 2.0)
    assert pump.swing(position, (0.7, 0.5))[1] == pytest.approx(1.2)
    assert pump.share(position, (0.7, 0.5)) == pytest.approx(pump.share(position, (0.0, 1.2)))
    # The same swing asks for the same, but for the damping of the shoulder's own velocity.
    damping = (
        2.0 * gains.damping * gains.servo * math.sqrt(1.569142 / plant.mechanism.mass(position, plant.packed)[1][1])
    )
    still, moving = (_accelerations(plant, pump, position, v, 0.0)[0] for v in ((0.0, 1.2), (0.7, 0.5)))
    assert moving - still == pytest.approx(-damping * 0.7, rel=1e-4)


@pytest.mark.parametrize("name", ["acrobot_frictionless", "double_pendulum", "double_pendulum_frictionless"])
def test_a_pump_is_refused_where_no_law_is_known(name: str) -> None:
    plant = load_mechanism(name)
    with pytest.raises(
        DesignError, match=rf"plant '{name}' is a double_pendulum with motors at .*; expected cart_pole"
    ):
        EnergyPump(plant, PumpGains(1.0, 0.3, 0.5), 1.0)


def test_it_learns_from_passes_hands_over_upright_and_forgets_both_when_it_begins_anew() -> None:
    controller = _controller(PLANTS["cart_pole"])
    controller.efforts(0.0, (0.0, math.pi - 0.1), (0.0, 8.0))
    pumped = controller.efforts(0.01, (0.0, math.pi + 0.1), (0.0, 8.0))
    assert controller.margin.value == pytest.approx(0.005)
    assert not controller.catch.active
    assert pumped == (controller.pump.effort((0.0, math.pi + 0.1), (0.0, 8.0), 0.005),)
    held = controller.efforts(0.02, (1e-4, math.pi), (0.0, 0.0))
    assert controller.catch.active
    assert held == pytest.approx((-1e-4 * controller.catch.gain.K[0],))
    controller.reset()
    assert controller.margin.value == 0.01
    assert not controller.catch.active


def test_the_lqr_is_tried_between_the_nearer_of_reach_and_stop_on_either_side() -> None:
    plant = PLANTS["cart_pole"].with_values({"cart.lower_stop": -1.0, "cart.upper_stop": 2.0})
    assert _bounded(plant, 1.5).stops[0] == (-1.0, 1.5)
    assert _bounded(plant, 0.5).stops[0] == (-0.5, 0.5)
    assert _bounded(plant, math.inf) is plant
    shoulder = _bounded(PLANTS["pendubot_frictionless"], 1.2).stops[0]
    assert shoulder == pytest.approx((math.pi - 1.2, math.pi + 1.2))
