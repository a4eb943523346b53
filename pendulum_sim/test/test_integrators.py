"""Integrators: each has the order it claims, and the exponential ones are exact where they should be."""

from __future__ import annotations

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant, pendulum_plant
from pendulum_sim.stepping.integrators import INTEGRATORS, METHODS, get_integrator, phi_functions
from pendulum_sim.stepping.plant import RigidPlant

_SWINGING = pendulum_plant(inertia=0.15, damping=0.1, gravity=3.0)
_FIXED_STEP = [name for name in METHODS if name != "adaptive"]


def _final_state(parameters: PlantParameters, method: str, dt: float, duration: float) -> np.ndarray:
    plant = RigidPlant(parameters, dt, method=method)
    plant.reset(2.5, -1.0)
    for _ in range(round(duration / dt)):
        plant.step(0.4)
    return np.array([plant.theta, plant.theta_dot])


def _reference(parameters: PlantParameters, duration: float, effort: float) -> np.ndarray:
    m, b, g = parameters.inertia, parameters.damping, parameters.gravity
    solution = solve_ivp(
        lambda t, x: [x[1], (effort - b * x[1] - g * math.sin(x[0])) / m],
        (0.0, duration),
        [2.5, -1.0],
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
    )
    return solution.y[:, -1]


@pytest.mark.parametrize("method", _FIXED_STEP)
def test_the_global_error_falls_with_the_order_that_the_method_claims(method: str) -> None:
    duration = 1.6
    reference = _reference(_SWINGING, duration, 0.4)
    order = INTEGRATORS[method].order
    steps = np.array([0.02, 0.01, 0.005, 0.0025]) if order > 2 else np.array([4e-3, 2e-3, 1e-3, 5e-4])
    errors = [np.abs(_final_state(_SWINGING, method, dt, duration) - reference).max() for dt in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize(
    ("method", "bound"),
    [("euler", 1e-3), ("semi_implicit", 1e-3), ("rk4", 2e-6), ("etd2", 6e-8), ("etd4", 2e-10)],
)
def test_regulation_under_noise_stays_within_the_measured_error(method: str, bound: float) -> None:
    # 2 ms, closed loop, the thesis's noise: what each method costs in accuracy where the project uses it.
    plant_parameters = load_plant("thesis")
    efforts = noise.uniform_array(1, 0, 500, 2.5)

    def run(name: str, substeps: int) -> np.ndarray:
        plant = RigidPlant(plant_parameters, 0.002, method=name, substeps=substeps)
        state = plant.reset(math.pi)
        angles = []
        for disturbance in efforts:
            state = plant.step(disturbance - 33.345265 * (state.theta - math.pi) - 0.158993 * state.theta_dot)
            angles.append(state.theta)
        return np.array(angles)

    reference = run("etd4", 20)
    assert np.abs(run(method, 1) - reference).max() < bound


def test_exponential_methods_are_exact_without_gravity_at_any_step() -> None:
    parameters = pendulum_plant(inertia=0.055, damping=11.77, gravity=0.0)
    rate, dt = 11.77 / 0.055, 0.05
    for method in ("etd2", "etd4"):
        plant = RigidPlant(parameters, dt, method=method)
        plant.reset(0.3, 2.0)
        state = plant.step(1.5)
        final_speed = 1.5 / 11.77
        decay = math.exp(-rate * dt)
        assert state.theta_dot == pytest.approx(final_speed + (2.0 - final_speed) * decay, rel=1e-14)
        travelled = final_speed * dt + (2.0 - final_speed) * (1.0 - decay) / rate
        assert state.theta == pytest.approx(0.3 + travelled, rel=1e-14)


@pytest.mark.parametrize("z", [0.0, -1e-12, -1e-3, -0.43, -0.999, -1.0, -1.001, -5.0, -40.0, -300.0])
def test_phi_functions_match_their_series_in_50_digits(z: float) -> None:
    getcontext().prec = 400
    exact_z = Decimal(z)
    terms = [Decimal(1)]
    for n in range(1, 2600):
        terms.append(terms[-1] * exact_z / n)
    expected = [sum(terms, Decimal(0))]
    for k in range(1, 5):
        # phi_k = sum z^n / (n + k)!
        term = Decimal(1) / math.factorial(k)
        total = term
        for n in range(1, 2600):
            term *= exact_z / (n + k)
            total += term
        expected.append(total)
    for value, exact in zip(phi_functions(z), expected, strict=True):
        assert value == pytest.approx(float(exact), rel=5e-14, abs=1e-300)


def test_the_adaptive_reference_agrees_with_dop853_of_the_whole_run() -> None:
    duration = 1.6
    state = _final_state(_SWINGING, "adaptive", 0.02, duration)
    assert state == pytest.approx(_reference(_SWINGING, duration, 0.4), abs=1e-11)


def test_trajectories_equal_dop853_to_1e_12() -> None:
    duration = 0.5
    for parameters, dt in ((_SWINGING, 2.5e-4), (load_plant("thesis"), 5e-4)):
        state = _final_state(parameters, "etd4", dt, duration)
        assert state == pytest.approx(_reference(parameters, duration, 0.4), abs=1e-12)


def test_an_unknown_method_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(ParameterError, match="method is 'heun'; expected one of euler, semi_implicit, rk4"):
        get_integrator("heun")
