"""The laws of one joint command what the matrices of n joints do, and a pendulum is judged alike as either plant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.linear.analysis import delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError, continuous_lqr, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PRESETS, load_plant
from pendulum_sim.stepping.plants import make_pendulum

PERIOD = 0.01
LATE = {"lag": {"actuator_time_constant": 0.02}, "delay": {"transport_delay": 0.013}}
CHANGES: dict[str, dict[str, float]] = {"": {}, **LATE, "lag and delay": {**LATE["lag"], **LATE["delay"]}}
STOP = {"upper_stop": 1e3}
"""An end stop, out of reach, with which a pendulum is a mechanism like any other."""
WEIGHTS: dict[str, Any] = {"q": [100.0, 0.01], "r": 0.1}


@pytest.mark.parametrize("late", CHANGES)
def test_a_pendulum_has_the_same_linear_model_as_either_plant(late: str) -> None:
    for preset in PRESETS:
        plant = load_plant(preset).with_values(**CHANGES[late])
        if plant.drivetrain is not None:
            with pytest.raises(ParameterError, match="series elastic"):
                plant.with_values(**STOP)
            continue
        one, many = linearise(plant), linearise(plant.with_values(**STOP))
        for name in ("A", "B", "C", "E"):
            np.testing.assert_array_equal(getattr(one, name), getattr(many, name))
        assert (one.delay, one.position, one.efforts) == (many.delay, many.position, many.efforts)
        assert len(one.hidden) == len(many.hidden) == ("lag" in late)


@pytest.mark.parametrize("late", CHANGES)
@pytest.mark.parametrize("off", [0.03, 0.25])
@pytest.mark.parametrize("name", ["lqr", "lqi", "discrete_lqr"])
def test_a_law_commands_what_the_matrices_do_also_at_the_limit(name: str, off: float, late: str) -> None:
    plant = load_plant("dfki").with_values(coulomb_friction=0.0, static_friction=0.0, **CHANGES[late])
    law, matrices = (make_controller(name, plant, PERIOD, WEIGHTS) for _ in range(2))
    matrices._use(None, (), matrices.memory)  # type: ignore[attr-defined]
    simulated = make_pendulum(plant, PERIOD)
    state, efforts = simulated.reset(np.pi + off), []
    for k in range(400):
        arguments = (k * PERIOD, (state.theta,), (state.theta_dot,))
        efforts.append((*law.efforts(*arguments), *matrices.efforts(*arguments)))
        state = simulated.step(efforts[-1][0])
    assert (np.abs(efforts).max() > 0.999 * plant.effort_limit) == (off > 0.1)
    np.testing.assert_allclose(*np.array(efforts).T, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["lqr", "lqi"])
@pytest.mark.parametrize("lag", [0.0, 0.02])
def test_both_are_refused_from_the_same_delay_on_and_that_is_where_the_sampled_loop_stops_to_settle(
    name: str, lag: float
) -> None:
    integral = {"q_integral": 50.0} if name == "lqi" else {}

    def verdicts(delay: float) -> set[bool]:
        plant = load_plant("dfki").with_values(actuator_time_constant=lag, transport_delay=delay)
        found = set()
        for each in (plant, plant.with_values(**STOP)):
            try:
                make_controller(name, each, PERIOD, {**WEIGHTS, **integral})
                found.add(True)
            except DesignError as error:
                found.add("settle" not in str(error) and "unstable" not in str(error))
        return found

    low, high = 0.0, 0.2
    assert (verdicts(low), verdicts(high)) == ({True}, {False})
    for _ in range(9):
        middle = 0.5 * (low + high)
        (accepted,) = verdicts(middle)
        low, high = (middle, high) if accepted else (low, middle)
    model = linearise(load_plant("dfki").with_values(actuator_time_constant=lag, transport_delay=low))
    if name == "lqr":
        K = output_lqr(model, WEIGHTS["q"], WEIGHTS["r"]).K
        assert delayed_spectral_radius(model, K, PERIOD) < 1.0 < delayed_spectral_radius(model, K, PERIOD, high - low)


@pytest.mark.parametrize("period", [0.01, 0.002])
def test_the_gain_that_knows_nothing_of_the_lag_falls_and_is_not_given(period: float) -> None:
    plant = load_plant("dfki").with_values(actuator_time_constant=0.1)
    prompt = continuous_lqr(linearise(load_plant("dfki")), WEIGHTS["q"], WEIGHTS["r"])
    assert delayed_spectral_radius(linearise(plant), prompt.K, period) > 1.0
    made: Any = make_controller("lqr", plant, period, WEIGHTS)
    assert delayed_spectral_radius(linearise(plant), made.gain.K, period) < 1.0
