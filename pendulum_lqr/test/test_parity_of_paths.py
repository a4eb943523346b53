"""A plant of one joint through the path for one joint and through that for several: the same loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.controller import (
    controller_class,
    controller_names,
    controller_parameters,
    make_controller,
)
from pendulum_lqr.linear.analysis import delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError, continuous_lqr, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import mechanism_from_pendulum
from pendulum_msgs_py.plants.plant_parameters import PRESETS, PlantParameters, load_plant
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_sim.stepping.plants import make_plant

PERIOD = 0.01
LATE = {"lag": {"actuator_time_constant": 0.02}, "delay": {"transport_delay": 0.013}}
CHANGES: dict[str, dict[str, float]] = {"": {}, **LATE, "lag and delay": {**LATE["lag"], **LATE["delay"]}}
WEIGHTS = {"q": [100.0, 0.01], "r": 0.1}
SAME: dict[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    "lqr": (WEIGHTS, WEIGHTS),
    "lqi": ({**WEIGHTS, "q_integral": 50.0}, {**WEIGHTS, "q_integral": 50.0}),
    "discrete_lqr": (WEIGHTS, WEIGHTS),
    "lqg": ({**WEIGHTS, "torque_noise": 0.1}, {**WEIGHTS, "effort_noise": 0.1}),
    "mpc": ({**WEIGHTS, "horizon": 20, "angle_limit": 0.0}, {**WEIGHTS, "horizon": 20, "position_limits": [0.0]}),
}
OTHER_METHODS = {
    "energy_swing_up": "one joint pumps by the energy law, several by partial feedback of a passive joint",
    "tvlqr": "one joint plans its swing-up by CasADi when it is designed, several follow a stored one",
    "nmpc": "one joint plans by CasADi and IPOPT, several by iterative LQR",
    "policy": "the file of a policy names its joints, and those of one joint have another layout",
}


def _late(name: str, late: str) -> PlantParameters:
    return load_plant(name).with_values(**CHANGES[late])


def _both(name: str, plant: PlantParameters, period: float = PERIOD) -> tuple[Any, Any]:
    one, several = SAME[name]
    return (
        make_controller(name, plant, period, one),
        make_controller(name, mechanism_from_pendulum(plant), period, several),
    )


def _is_accepted(make: Callable[[], object]) -> bool:
    try:
        make()
    except DesignError as error:
        return "settle" not in str(error) and "unstable" not in str(error)
    return True


def _runs(name: str, plant: PlantParameters, off: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return angle from upright [rad] and effort [N m] of both loops over 4 s, shape (samples, 2) each."""
    one, several = _both(name, plant)
    first, second = make_plant(plant, PERIOD), MechanismPlant(mechanism_from_pendulum(plant), PERIOD)
    state, joints = first.reset(np.pi + off), second.reset((np.pi + off,))
    rows = []
    for k in range(400):
        efforts = (
            one.command(k * PERIOD, (from_upright(state.theta), state.theta_dot)),
            *several.efforts(k * PERIOD, joints.position, joints.velocity),
        )
        rows.append((from_upright(state.theta), from_upright(joints.position[0]), *efforts))
        state, joints = first.step(efforts[0]), second.step(efforts[1:])
    table = np.array(rows)
    return table[:, :2], table[:, 2:]


def test_every_controller_that_both_paths_have_is_compared_or_is_another_method() -> None:
    assert set(SAME) | set(OTHER_METHODS) == set(controller_names()) & set(controller_names(several=True))


@pytest.mark.parametrize("late", CHANGES)
@pytest.mark.parametrize(
    "preset",
    [
        pytest.param(
            name,
            marks=pytest.mark.xfail(
                reason="a joint of a mechanism has no drivetrain", strict=True, raises=ParameterError
            )
            if load_plant(name).drivetrain is not None
            else (),
        )
        for name in PRESETS
    ],
)
def test_one_joint_has_the_same_model_gain_and_loop_through_both_paths(preset: str, late: str) -> None:
    plant = _late(preset, late)
    one, many = linearise(plant), linearise(mechanism_from_pendulum(plant))
    for name in ("A", "B", "C", "E"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))
    assert (one.delay, one.efforts, len(one.hidden)) == (many.delay, many.efforts, len(many.hidden))
    assert len(one.hidden) == ("lag" in late)
    for name in SAME:
        first, second = _both(name, plant)
        np.testing.assert_allclose(first.gain.K, second.gain.K, rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("late", CHANGES)
@pytest.mark.parametrize("off", [0.03, 0.25])
@pytest.mark.parametrize("name", SAME)
def test_one_joint_moves_alike_through_both_paths_also_from_where_the_torque_is_at_its_limit(
    name: str, off: float, late: str
) -> None:
    plant = _late("dfki", late).with_values(coulomb_friction=0.0, static_friction=0.0)
    angles, efforts = _runs(name, plant, off)
    assert (np.abs(efforts).max() > 0.999 * plant.effort_limit) == (off > 0.1)
    # Two solutions of a quadratic program within the tolerance of its solver.
    angle, effort = (2e-5, 5e-3) if name == "mpc" else (1e-6, 1e-4)
    np.testing.assert_allclose(angles[:, 0], angles[:, 1], rtol=0.0, atol=angle)
    np.testing.assert_allclose(efforts[:, 0], efforts[:, 1], rtol=0.0, atol=effort)


@pytest.mark.parametrize("name", ["lqr", "lqi"])
@pytest.mark.parametrize("lag", [0.0, 0.02])
def test_both_paths_refuse_from_the_same_delay_on_and_that_is_where_the_sampled_loop_stops_to_settle(
    name: str, lag: float
) -> None:
    def verdicts(delay: float) -> list[bool]:
        plant = load_plant("dfki").with_values(actuator_time_constant=lag, transport_delay=delay)
        one, several = SAME[name]
        makers: list[Callable[[], object]] = [
            lambda: make_controller(name, plant, PERIOD, one),
            lambda: make_controller(name, mechanism_from_pendulum(plant), PERIOD, several),
        ]
        return [_is_accepted(make) for make in makers]

    low, high = 0.0, 0.2
    assert (verdicts(low), verdicts(high)) == ([True, True], [False, False])
    for _ in range(9):
        middle = 0.5 * (low + high)
        first, second = verdicts(middle)
        assert first == second
        low, high = (middle, high) if first else (low, middle)
    model = linearise(load_plant("dfki").with_values(actuator_time_constant=lag, transport_delay=low))
    if name == "lqr":
        K = output_lqr(model, WEIGHTS["q"], WEIGHTS["r"]).K
        assert delayed_spectral_radius(model, K, PERIOD) < 1.0 < delayed_spectral_radius(model, K, PERIOD, high - low)


@pytest.mark.parametrize(("lag", "period"), [(0.1, 0.01), (0.1, 0.002)])
def test_the_gain_that_knows_nothing_of_the_lag_falls_and_is_given_by_neither_path(lag: float, period: float) -> None:
    plant = load_plant("dfki").with_values(actuator_time_constant=lag)
    prompt = continuous_lqr(linearise(load_plant("dfki")), WEIGHTS["q"], WEIGHTS["r"])
    assert delayed_spectral_radius(linearise(plant), prompt.K, period) > 1.0
    for made in _both("lqr", plant, period):
        assert delayed_spectral_radius(linearise(plant), made.gain.K, period) < 1.0


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.xfail(reason=why, strict=True)) for name, why in OTHER_METHODS.items()],
)
def test_a_controller_that_both_paths_have_takes_the_same_parameters(name: str) -> None:
    plant = mechanism_from_pendulum(load_plant("dfki"))
    one = {spec.name for spec in controller_parameters(name)}
    assert {spec.name for spec in controller_class(name, plant).parameters(plant)} >= one
