"""Swing-up by energy of plants whose one motor moves the hinge of a pendulum."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.joint_energy_swing_up import JointEnergySwingUp
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.swing_up.catch import make_mechanism_catch
from pendulum_lqr.swing_up.energy_margin import EnergyMargin
from pendulum_lqr.swing_up.pump import EnergyPump, pump_gains
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

PERIOD = 0.01


def _swing(
    controller: Controller, plant: PlantParameters, start: Vector, duration: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, deviations from upright, and efforts."""
    simulated = MechanismPlant(plant, dt=PERIOD)
    state = simulated.reset(start)
    positions, deviations, efforts = [], [], []
    for k in range(round(duration / PERIOD)):
        efforts.append(controller.efforts(k * PERIOD, state.position, state.velocity)[0])
        state = simulated.step((efforts[-1],))
        positions.append(state.position)
        deviations.append(plant.coordinates.deviation(state.position))
    return np.array(positions), np.array(deviations), np.array(efforts)


@pytest.mark.parametrize(
    ("name", "duration", "limit", "reach"),
    [
        ("cart_pole", 8.0, 0.0, 1.62),
        ("cart_pole", 14.0, 6.0, 1.62),
        ("furuta", 4.0, 0.0, 2.0),
        ("pendubot_frictionless", 12.0, 0.0, 0.0),
    ],
)
def test_it_swings_up_from_hanging_within_limit_and_reach(
    name: str, duration: float, limit: float, reach: float
) -> None:
    plant = load_mechanism(name)
    controller = make_controller("energy_swing_up", plant, PERIOD, {"effort_limit": limit})
    for start in ((0.0, 0.0), (0.1, -0.2)):
        controller.reset()
        positions, deviations, efforts = _swing(controller, plant, start, duration)
        assert np.abs(deviations[-50:]).max() < 0.15
        most = limit or plant.effort_limits[0]
        assert 0.5 * most < np.abs(efforts).max() <= most
        if reach:
            assert np.abs(positions[:, plant.coordinates.driven[0]]).max() < 1.02 * reach
    controller.reset()
    again = _swing(controller, plant, (0.1, -0.2), 1.0)[2]
    assert (again == efforts[: len(again)]).all()


@pytest.mark.parametrize(("name", "seed"), [("furuta", 11), ("furuta", 19), ("cart_pole", 2)])
def test_it_learns_to_aim_below_upright_where_the_model_has_more_friction_than_the_plant(name: str, seed: int) -> None:
    plant = load_mechanism(name)
    controller = make_controller("energy_swing_up", plant, PERIOD)
    machines = pytest.importorskip("pendulum_bags.experiments.joint_run")
    lighter = machines.surrogate_for(plant, share=0.05, delay=0.0, seed=seed)
    start = tuple(float(value) for value in np.random.default_rng(seed - 1).uniform(-0.2, 0.2, 2))
    _, deviations, _ = _swing(controller, lighter, start, 15.0)
    assert np.abs(deviations[-50:]).max() < 0.2
    assert controller.margin.value < 0.0


def test_the_margin_falls_with_each_pass_and_rises_with_each_turn_before_upright() -> None:
    margin = EnergyMargin(0.1, rest=0.05)
    seen = []
    for angle, velocity in (
        (-0.2, 1.0), (0.2, 1.0), (0.4, 1.0),  # passes once
        (0.5, -1.0),  # turns back
        (0.5, 0.01),  # too slow to tell
        (-0.1, -1.0), (0.1, 1.0),  # passes twice
    ):  # fmt: skip
        margin.learn(angle, velocity)
        seen.append(margin.value)
    assert seen == pytest.approx([0.1, 0.05, 0.05, 0.085, 0.085, 0.0425, 0.02125])
    for angle in (0.1, -0.1) * 100:
        margin.learn(angle, 1.0)
    assert margin.value == -0.2
    margin.learn(0.1, -1.0)
    margin.learn(0.2, 1.0)
    assert margin.value == pytest.approx(-0.19)
    far = EnergyMargin(0.1)
    far.learn(2.0, 1.0)
    far.learn(-2.0, 1.0)
    far.learn(-2.0, -1.0)
    assert far.value == 0.1
    other = EnergyMargin(0.0)
    other.take_over(margin)
    assert other.value == margin.value
    margin.reset()
    assert margin.value == 0.1


@pytest.mark.parametrize(
    ("states", "learnt"),
    [
        (((-2.0, 1.0), (0.5, 1.0)), 0.1),  # from afar
        (((0.5, -1.0), (-2.0, -1.0)), 0.1),  # to afar
        (((0.5, 5.0), (-0.5, 5.0)), 0.05),  # fast
        (((0.0, 1.0), (0.1, 1.0)), 0.1),  # begins upright
        (((0.5, 0.5), (0.6, 0.5)), 0.1),  # goes on slowly
        (((0.5, 0.0), (0.5, 1.0)), 0.1),  # begins at rest
        (((-0.5, 1.0), (-0.5, -1.0)), 0.16),  # turns back
    ],
)
def test_only_what_happens_near_upright_tells_how_to_aim(states: tuple[Vector, Vector], learnt: float) -> None:
    margin = EnergyMargin(0.1)
    for state in states:
        margin.learn(*state)
    assert margin.value == pytest.approx(learnt)


def test_the_driven_joint_goes_no_farther_than_it_may() -> None:
    plant = load_mechanism("cart_pole")
    wide, narrow = (make_controller("energy_swing_up", plant, PERIOD, {"reach": reach}) for reach in (10.0, 0.8))
    # Nine tenths of the way to the stops bound what is asked for.
    assert wide.pump.reach == pytest.approx(1.62)
    positions, deviations, _ = _swing(narrow, plant, (0.0, 0.1), 15.0)
    assert np.abs(positions[:, 0]).max() < 0.82
    assert np.abs(deviations[-50:]).max() < 0.1
    # The LQR takes over only from where it stays within, too.
    assert narrow.catch.region.level < wide.catch.region.level
    # Beyond its reach it comes back, however it moves.
    assert narrow.efforts(0.0, (1.2, 0.5), (0.0, 3.0))[0] < 0.0
    assert narrow.efforts(0.0, (-1.2, 0.5), (-0.5, -3.0))[0] > 0.0


def test_the_dry_friction_of_the_driven_joint_is_made_up_for_in_the_way_that_it_goes() -> None:
    plant = load_mechanism("cart_pole")
    rough = plant.with_values({"cart.coulomb_friction": 0.7})
    smooth_pump, rough_pump = (EnergyPump(each, pump_gains(each), 100.0) for each in (plant, rough))
    for speed in (0.2, -0.2):
        state = ((0.1, 0.4), (speed, 1.0), 0.0)
        assert rough_pump.effort(*state) - smooth_pump.effort(*state) == pytest.approx(math.copysign(0.7, speed))


def test_no_state_counts_as_caught_that_runs_into_an_end_stop() -> None:
    plant = load_mechanism("cart_pole")
    near = plant.with_values({"cart.lower_stop": -0.1, "cart.upper_stop": 0.1})
    left, right = (
        plant.with_values({f"cart.{stop}": end}) for stop, end in (("lower_stop", -0.1), ("upper_stop", 0.1))
    )
    free, *bounded = (
        make_mechanism_catch(each, *plant.mechanism.weights).region.level for each in (plant, near, left, right)
    )
    assert max(bounded) < 0.3 * free


def test_what_cannot_be_swung_up_so_is_refused_with_what_to_take() -> None:
    for name, motors in (("acrobot_frictionless", "elbow"), ("double_pendulum", "shoulder, elbow")):
        with pytest.raises(DesignError, match=rf"{name}' is a double_pendulum with motors at {motors}; .*ilqr, nmpc"):
            JointEnergySwingUp.parameters(load_mechanism(name))
    stiff = load_mechanism("furuta").with_values({"arm.coulomb_friction": 0.02})
    with pytest.raises(DesignError, match=r"effort_limit is 0\.01 N m; .* the friction that holds arm, 0\.02 N m"):
        make_controller("energy_swing_up", stiff, PERIOD, {"effort_limit": 0.01})
    with pytest.raises(DesignError, match=r"effort_limit is 0\.02 N m; expected more"):
        make_controller("energy_swing_up", stiff, PERIOD, {"effort_limit": 0.02})
    for changed in ({"gravity": 0.0}, {"pole_centre": 0.0}):
        floating = load_mechanism("cart_pole").with_values(changed)
        with pytest.raises(DesignError, match="pole of plant 'cart_pole' cannot be swung up by cart"):
            EnergyPump(floating, pump_gains(floating), 1.0)


def test_who_takes_over_knows_what_was_learnt_and_whether_the_lqr_is_in_charge() -> None:
    plant = load_mechanism("cart_pole")
    old, new = (make_controller("energy_swing_up", plant, PERIOD) for _ in range(2))
    old.margin.value = 0.03
    upright = (plant.coordinates.goal, (0.0, 0.0))
    old.efforts(0.0, *upright)
    new.carry_over(old)
    assert new.margin.value == 0.03
    assert new.catch.active
    new.reset()
    assert not new.catch.active
    assert new.margin.value == 0.0
    shared = make_controller("energy_swing_up", plant, PERIOD, {"catch_share": 0.1})
    level = old.catch.region.level
    assert shared.catch.region.level == pytest.approx(0.1 * level)
    assert shared.catch.leave * shared.catch.region.level == pytest.approx(old.catch.leave * level)
    assert "pumps by cart within 1.62 m, LQR K" in old.describe()


@pytest.mark.parametrize("name", ["lqr", "energy_swing_up"])
def test_a_period_that_is_measured_later_is_judged_without_another_design(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller = make_controller(name, load_mechanism("cart_pole"), 0.01, checked=False)
    monkeypatch.setattr("pendulum_lqr.swing_up.catch.sample_caught_region", lambda *_: pytest.fail("designed again"))
    monkeypatch.setattr("pendulum_lqr.controllers.lqr.output_lqr", lambda *_: pytest.fail("designed again"))
    controller.check(0.01)
    with pytest.raises(ParameterError, match=rf"{name} asked every 0\.5 s does not settle on plant 'cart_pole'"):
        controller.check(0.5)


def test_its_energy_is_that_of_the_pendulum_alone_with_the_driven_joint_at_rest() -> None:
    plant = load_mechanism("furuta")
    pump = EnergyPump(plant, pump_gains(plant), 1.0)
    assert pump.share((0.0, 0.0), (0.0, 0.0)) == pytest.approx(0.0, abs=1e-12)
    assert pump.share((0.7, math.pi), (0.0, 0.0)) == pytest.approx(1.0)
    lowest, top = (plant.energy((0.0, angle), (0.0, 0.0)) for angle in (0.0, math.pi))
    moving = plant.energy((0.0, 1.1), (0.0, 2.5))
    assert pump.share((0.0, 1.1), (0.0, 2.5)) == pytest.approx((moving - lowest) / (top - lowest))
