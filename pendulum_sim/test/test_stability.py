"""What would blow up is refused, and what is refused would blow up: integrators judged at their steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant, pendulum_plant
from pendulum_sim.batches.batch import simulate_batch
from pendulum_sim.environments.environment import PlantEnv, PlantVectorEnv
from pendulum_sim.stepping.integrators import METHODS, get_integrator
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_sim.stepping.series_elastic import SeriesElasticPlant
from pendulum_sim.stepping.stability import MOST_GROWTH, growth_rate, stable_substeps

_THESIS = load_plant("thesis")
_PLANTS = {
    "thesis": _THESIS,
    "dfki": load_plant("dfki"),
    "stiff": pendulum_plant(inertia=1e-4, damping=1e-5, gravity=3.0),
    "undamped": pendulum_plant(inertia=0.1, damping=0.0, gravity=2.0),
}
_FIXED_STEP = [name for name in METHODS if name != "adaptive"]


def _energies(plant: PlantParameters, method: str, h: float) -> tuple[float, float]:
    """Return the energy near rest, hanging, at the start and after 1000 steps or 2 s; free and without dry friction."""
    integrator = get_integrator(method)
    c = integrator.coefficients(plant.damping / plant.inertia, h)
    x, v = 1e-3, 0.0

    def acceleration(theta: float, theta_dot: float, torque: float, direction: float, _: tuple[float, ...]) -> float:
        return (torque + direction - plant.damping * theta_dot - plant.gravity * math.sin(theta)) / plant.inertia

    def energy() -> float:
        return 0.5 * plant.inertia * v * v + plant.gravity * (1.0 - math.cos(x))

    before = energy()
    for _ in range(max(1000, round(2.0 / h))):
        x, v = integrator.step(acceleration, x, v, 0.0, 0.0, 0.0, 0.0, h, c, ())
        if not abs(x) + abs(v) < 1e6:
            return before, math.inf
    return before, energy()


@pytest.mark.parametrize("method", _FIXED_STEP)
@pytest.mark.parametrize("name", _PLANTS)
def test_what_is_refused_gains_energy_in_free_swing_and_what_is_not_does_not(name: str, method: str) -> None:
    plant = _PLANTS[name]
    integrator = get_integrator(method)
    rate, stiffness = plant.damping / plant.inertia, plant.gravity / plant.inertia
    judged = set()
    for h in np.geomspace(2e-4, 0.05, 12):
        coefficients = [np.float64(value) for value in integrator.coefficients(rate, float(h))]
        growth = float(growth_rate(integrator, rate, stiffness, float(h), coefficients))
        if abs(growth - MOST_GROWTH) < 0.05:
            continue
        before, after = _energies(plant, method, float(h))
        duration = max(1000 * h, 2.0)
        grown = after > before * math.exp(2.0 * MOST_GROWTH * duration)
        assert grown == (growth > MOST_GROWTH), f"step {h:.2e} s: growth {growth:.3g} 1/s, energy {before} to {after}"
        judged.add(grown)
    if method in {"euler", "rk4"} and name == "thesis":
        assert judged == {True, False}


@pytest.mark.parametrize(
    ("method", "rate_hz", "substeps"), [("euler", 100.0, 2), ("euler", 50.0, 3), ("rk4", 50.0, 2), ("rk4", 75.0, 2)]
)
def test_an_unstable_method_is_refused_with_the_way_out_wherever_it_is_chosen(
    method: str, rate_hz: float, substeps: int
) -> None:
    dt = 1.0 / rate_hz
    assert stable_substeps(get_integrator(method), _THESIS, dt) == substeps
    message = f"method '{method}' is unstable on plant 'thesis'.*expected substeps >= {substeps} or method etd4"
    with pytest.raises(ParameterError, match=message):
        RigidPlant(_THESIS, dt, method=method)
    with pytest.raises(ParameterError, match=message):
        simulate_batch(_THESIS, steps=10, dt=dt, method=method)
    with pytest.raises(ParameterError, match=f"method '{method}' is unstable on plant 'thesis'"):
        PlantEnv(dt=dt, method=method)
    with pytest.raises(ParameterError, match=f"method '{method}' is unstable on plant 'thesis'"):
        PlantVectorEnv(2, dt=dt, method=method)
    plant = RigidPlant(_THESIS, dt, method=method, substeps=substeps)
    plant.reset(2.0)
    energies = []
    for _ in range(int(2.0 / dt)):
        plant.step(0.0)
        energies.append(plant.energy)
    assert energies[-1] < energies[0]


def test_one_unstable_plant_among_those_of_a_batch_is_found() -> None:
    damping = np.linspace(2.0, 60.0, 300)
    with pytest.raises(ParameterError, match=r"damping 1091 1/s\) at a step of 2 ms"):
        simulate_batch(_THESIS, steps=10, dt=2e-3, method="euler", variations={"damping": damping})
    plants = [_THESIS, _THESIS.with_values(inertia=0.002, name="light")]
    with pytest.raises(ParameterError, match="on plant 'light'"):
        simulate_batch(plants, steps=10, dt=2e-3, method="euler")


def test_a_delay_that_cuts_the_period_is_judged_at_its_longest_piece() -> None:
    delayed = _THESIS.with_values(transport_delay=0.005)
    # 10 ms in two halves: each is stable where the whole is not.
    RigidPlant(delayed, 0.01, method="euler")
    with pytest.raises(ParameterError, match=r"at a step of 9\.5 ms"):
        RigidPlant(_THESIS.with_values(transport_delay=0.0005), 0.01, method="euler")


@pytest.mark.parametrize("name", ["thesis", "dfki", "x5_9"])
@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 500.0, 2000.0])
def test_the_default_integrator_is_stable_on_every_preset_at_every_rate(name: str, rate_hz: float) -> None:
    plant = make_pendulum(load_plant(name), 1.0 / rate_hz)
    plant.reset(2.0)
    for _ in range(round(2.0 * rate_hz)):
        plant.step(0.0)
    assert abs(plant.state.theta) < 2.0 + 1e-9


def test_a_series_elastic_plant_refuses_steps_at_which_motor_or_spring_blow_up() -> None:
    x5_9 = load_plant("x5_9")
    assert x5_9.drivetrain is not None
    stiff = x5_9.with_values(drivetrain=replace(x5_9.drivetrain, stiffness=3000.0), name="stiff")
    with pytest.raises(ParameterError, match="motor and spring are unstable; expected substeps >= 2"):
        SeriesElasticPlant(x5_9, 0.05, substeps=1)
    with pytest.raises(ParameterError, match=r"plant 'stiff' is 10 ms .*expected substeps >= (\d+)") as caught:
        SeriesElasticPlant(stiff, 0.01, substeps=1)
    enough = int(str(caught.value).rsplit(maxsplit=1)[-1])
    # As said: one less explodes, as many hold.
    with pytest.raises(ParameterError):
        SeriesElasticPlant(stiff, 0.01, substeps=enough - 1)
    plant = SeriesElasticPlant(stiff, 0.01, substeps=enough)
    plant.reset(1.0)
    for _ in range(300):
        state = plant.step(0.0)
    assert abs(state.theta) < 1.01
