"""Quadratic drag and periodic torques against scipy's integrator, with the equations written out here."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import (
    PlantParameters,
    load_mechanism,
    load_plant,
    pendulum_plant,
    write_plant,
)
from pendulum_sim.batches.batch import simulate_batch
from pendulum_sim.environments.environment import PlantEnv
from pendulum_sim.exports import model_files
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_sim.stepping.plants import make_plant

_OWN = {
    "quadratic_drag": 0.03, "torque_cos_2": 0.1, "torque_sin_2": -0.05, "torque_cos_3": 0.04, "torque_sin_3": 0.06
}  # fmt: skip
_LINK = pendulum_plant(0.06, 0.01, 1.7, angle_offset=0.1, torque_offset=0.05, **_OWN)
_TWO = load_mechanism("double_pendulum_frictionless").with_values(
    {f"{joint}.{name}": value for joint in ("shoulder", "elbow") for name, value in _OWN.items()}
)


def _torque(angle: float, velocity: float) -> float:
    found = 0.1 * math.cos(2 * angle) - 0.05 * math.sin(2 * angle) + 0.04 * math.cos(3 * angle)
    return found + 0.06 * math.sin(3 * angle) - 0.03 * velocity * abs(velocity)


def _link(_t: float, x: np.ndarray, effort: float = 0.4) -> list[float]:
    angle = x[0] - 0.1
    return [x[1], (effort + 0.05 + _torque(angle, x[1]) - 0.01 * x[1] - 1.7 * math.sin(angle)) / 0.06]


def _two(_t: float, x: np.ndarray) -> list[float]:
    own = tuple(_torque(q, v) for q, v in zip(x[:2], x[2:], strict=True))
    bare = load_mechanism("double_pendulum_frictionless")
    return [x[2], x[3], *bare.acceleration(tuple(x[:2]), tuple(x[2:]), own)]


def _end(rates: object, start: list[float], seconds: float) -> np.ndarray:
    return solve_ivp(rates, (0.0, seconds), start, rtol=1e-11, atol=1e-12).y[:, -1]  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("plant", "rates", "start", "effort"),
    [(_LINK, _link, [0.3, 9.0], (0.4,)), (_TWO, _two, [0.3, -0.4, 6.0, -5.0], (0.0, 0.0))],
)
def test_a_plant_moves_by_its_equation(
    plant: PlantParameters, rates: object, start: list[float], effort: tuple[float, ...]
) -> None:
    n = len(effort)
    single = make_plant(plant, 1e-3)
    single.reset(tuple(start[:n]), tuple(start[n:]))
    for _ in range(500):
        state = single.step(effort, (0.0,) * n)
    exact = _end(rates, start, 0.5)
    np.testing.assert_allclose([*state.position, *state.velocity], exact, rtol=1e-6)


# Each compiles kernels: ten seconds of a free core.
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("plant", "rates", "start"),
    [
        (_LINK, lambda t, x: _link(t, x, 0.0), [0.3, 9.0]),
        (_LINK.with_values(coulomb_friction=1e-12), lambda t, x: _link(t, x, 0.0), [0.3, 9.0]),
        (_TWO, _two, [0.3, -0.4, 6.0, -5.0]),
    ],
)
def test_a_batch_moves_by_the_same_equation(plant: PlantParameters, rates: object, start: list[float]) -> None:
    n = len(plant.joints)
    found = simulate_batch(
        plant, steps=300, dt=1e-3, position=np.tile(start[:n], (3, 1)), velocity=start[n:], record=False
    )
    exact = _end(rates, start, 0.3)
    np.testing.assert_allclose(np.hstack([found.position, found.velocity])[2], exact, rtol=1e-6)


@pytest.mark.timeout(400)
def test_an_environment_steps_the_same_equation() -> None:
    environment = PlantEnv(_LINK)
    environment.reset(options={"state": np.array([0.3 - math.pi, 9.0])})
    for _ in range(10):
        seen, *_ = environment.step(np.array([0.4]))
    exact = _end(_link, [0.3, 9.0], 10 * environment.dt)
    assert math.remainder(seen[0] + math.pi - exact[0], math.tau) == pytest.approx(0.0, abs=1e-5)
    assert seen[1] == pytest.approx(exact[1], rel=1e-4)


def test_a_link_rests_where_dry_friction_exceeds_its_own_torque() -> None:
    flat = pendulum_plant(0.05, 0.0, 0.0, torque_cos_2=0.2, coulomb_friction=0.15)
    plant = RigidPlant(flat, 1e-3)
    plant.reset(0.5 * math.acos(0.7))
    assert plant.step(0.0).theta_dot == 0.0
    plant.reset(0.5 * math.acos(0.8))
    assert plant.step(0.0).theta_dot > 0.0


def test_energy_is_constant_without_drag() -> None:
    plant = RigidPlant(pendulum_plant(0.05, 0.0, 1.0, torque_cos_2=0.2, torque_sin_3=0.3, angle_offset=0.2), 1e-3)
    plant.reset(1.0, 2.0)
    before = plant.energy
    for _ in range(2000):
        plant.step(0.0)
    assert plant.energy == pytest.approx(before, abs=1e-7)


def test_a_link_behind_a_spring_is_slowed_by_its_own_torque() -> None:
    # In the first milliseconds nothing else moves it.
    bare = load_plant("x5_9")
    plant = make_plant(bare.with_values(torque_cos_2=0.5), 1e-3)
    plant.reset((0.0,), (0.0,))
    for _ in range(4):
        state = plant.step((0.0,), (0.0,))
    assert state.velocity[0] == pytest.approx(0.004 * 0.5 / bare.inertia, rel=0.25)


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_exports_refuse_what_their_formats_cannot_express(kind: str, tmp_path, capsys) -> None:
    write_plant(tmp_path / "own.yaml", _LINK)
    code = model_files.main(
        ["--plant", str(tmp_path / "own.yaml"), "--format", kind, "--out", str(tmp_path / "own.xml")]
    )
    said = " ".join(capsys.readouterr().err.split())
    assert (code, (tmp_path / "own.xml").exists()) == (2, False)
    assert f"quadratic_drag of pendulum_joint is 0.03 N m s^2/rad^2, which {kind.upper()} cannot express" in said


def test_plants_of_a_batch_all_have_torques_or_none() -> None:
    with pytest.raises(ParameterError, match="differ; expected one mechanism"):
        simulate_batch([_TWO, load_mechanism("double_pendulum_frictionless")], steps=1)
