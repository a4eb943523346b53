"""Mechanisms: equations against Lagrange's own, in every arithmetic, and their energy."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from pendulum_msgs_py.contract.joints import Coordinates, Joint
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.dynamics.rigid import rigid_acceleration
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

_PLANTS = ("thesis", "cart_pole", "acrobot", "furuta", "reaction_wheel", "triple_pendulum")


def _plant(name: str) -> PlantParameters:
    plant = load_mechanism(name)
    return plant.with_values({f"{joint}.damping": 0.01 * (1 + n) for n, joint in enumerate(plant.coordinates.names)})


def _states(plant: PlantParameters, count: int = 20) -> list[tuple[tuple[float, ...], ...]]:
    n = len(plant.joints)
    values = np.random.default_rng(1).uniform(-6.0, 6.0, (count, 3, n))
    return [tuple(tuple(row) for row in state.tolist()) for state in values]


def _lagrange(plant: PlantParameters, q: tuple, v: tuple, torque: tuple) -> np.ndarray:
    """q'' of d/dt (M v) - dT/dq + dV/dq + D v = torque, from mass matrix and potential alone."""
    mechanism, p, n = plant.mechanism, plant.packed, len(q)
    mass = in_arithmetic(mechanism.mass, cmath)
    M = np.array(mechanism.mass(q, p))
    dM = np.array(complex_step(lambda *x: tuple(e for row in mass(x, p) for e in row), q)).reshape(n, n, n)
    gradient = np.array(complex_step(lambda *x: (in_arithmetic(mechanism.potential, cmath)(x, p),), q))[0]
    coriolis = np.einsum("ijk,k,j->i", dM, v, v) - 0.5 * np.einsum("jki,j,k->i", dM, v, v)
    return np.linalg.solve(M, np.array(torque) - coriolis - gradient - np.array(p[-n:]) * v)


@pytest.mark.parametrize("name", _PLANTS)
def test_the_equations_are_those_of_lagrange_from_mass_matrix_and_potential(name: str) -> None:
    plant = _plant(name)
    for q, v, torque in _states(plant):
        np.testing.assert_allclose(plant.acceleration(q, v, torque), _lagrange(plant, q, v, torque), rtol=1e-9)


@pytest.mark.parametrize("name", _PLANTS)
def test_floats_complex_numbers_arrays_and_symbols_give_one_acceleration(name: str) -> None:
    casadi = pytest.importorskip("casadi")
    plant = _plant(name)
    forward, p, n = plant.mechanism.forward, plant.packed, len(plant.joints)
    states = _states(plant)
    expected = np.array([forward(*state, p) for state in states])
    by_cmath = [[value.real for value in in_arithmetic(forward, cmath)(*state, p)] for state in states]
    columns = np.array(states)
    grids = [tuple(columns[:, part].T) for part in range(3)]
    by_numpy = np.array(in_arithmetic(forward, np)(*grids, p)).T
    symbols = [casadi.SX.sym(part, n) for part in ("q", "v", "torque")]
    parts = [tuple(casadi.vertsplit(symbol)) for symbol in symbols]
    function = casadi.Function("f", symbols, [casadi.vertcat(*in_arithmetic(forward, casadi)(*parts, p))])
    by_casadi = [np.array(function(*state)).ravel() for state in states]
    for values in (by_cmath, by_numpy, by_casadi):
        np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", _PLANTS)
def test_energy_changes_by_the_power_of_torque_and_damping_alone(name: str) -> None:
    plant = _plant(name)
    n = len(plant.joints)
    for q, v, torque in _states(plant):
        acceleration = plant.acceleration(q, v, torque)

        def energy(*x: complex) -> tuple[complex, ...]:
            mass = in_arithmetic(plant.mechanism.mass, cmath)(x[:n], plant.packed)
            kinetic = sum(x[n + i] * mass[i][j] * x[n + j] for i in range(n) for j in range(n))
            return (0.5 * kinetic + in_arithmetic(plant.mechanism.potential, cmath)(x[:n], plant.packed),)

        rate = float(np.dot(complex_step(energy, (*q, *v))[0], (*v, *acceleration)))
        power = sum(w * (u - d * w) for w, u, d in zip(v, torque, plant.packed[-n:], strict=True))
        assert rate == pytest.approx(power, rel=1e-9, abs=1e-9)
        assert plant.energy(q, v) == pytest.approx(energy(*q, *v)[0])


def test_the_pendulum_as_a_mechanism_is_the_equation_of_the_thesis_bit_for_bit() -> None:
    plant = load_mechanism("thesis")
    for (q,), (v,), (u,) in _states(plant, 200):
        assert plant.acceleration((q,), (v,), (u,)) == (rigid_acceleration(q, v, u, 0.055, 11.77, 1.678),)


@pytest.mark.parametrize("name", _PLANTS)
def test_every_mechanism_rests_upright_and_hanging_without_torque(name: str) -> None:
    plant = _plant(name)
    still = (0.0,) * len(plant.joints)
    for q in (plant.coordinates.goal, still):
        assert plant.acceleration(q, still, still) == pytest.approx(still, abs=1e-12)
    assert plant.energy(plant.coordinates.goal, still) > plant.energy(still, still) == 0.0


@pytest.mark.parametrize("name", _PLANTS)
def test_the_chain_that_is_drawn_hangs_down_at_zero_and_stands_at_the_goal(name: str) -> None:
    plant = _plant(name)
    down, up = (plant.mechanism.chain(q, plant.packed) for q in ((0.0,) * len(plant.joints), plant.coordinates.goal))
    assert down[-1][2] < down[0][2] < up[-1][2]
    assert down[-1][2] == pytest.approx(-up[-1][2])
    assert len(plant.mechanism.bodies(plant.packed)) == len(plant.mechanism.joints)


def test_only_what_turns_is_wrapped() -> None:
    coordinates = load_mechanism("cart_pole").coordinates
    assert coordinates.deviation((7.0, math.pi + 2.0 * math.pi)) == pytest.approx((7.0, 0.0))
    assert coordinates.names == ("cart", "pole")
    assert coordinates.driven_names == ("cart",)


def test_efforts_go_to_the_driven_joints_and_to_no_other() -> None:
    assert load_mechanism("acrobot").coordinates.spread((1.5,)) == (0.0, 1.5)
    assert load_mechanism("pendubot").coordinates.spread((1.5,)) == (1.5, 0.0)
    with pytest.raises(ParameterError, match=r"effort has 2 values; expected 1, for elbow"):
        load_mechanism("acrobot").coordinates.spread((1.5, 0.0))


def test_a_joint_that_slides_cannot_turn() -> None:
    with pytest.raises(ParameterError, match="expected rad, or m without turns"):
        Joint("cart", unit="m")


def test_mechanisms_have_a_name_for_each_value_and_joints_of_their_own() -> None:
    for mechanism in MECHANISMS.values():
        names = mechanism.parameter_names
        assert len(set(names)) == len(names) == len(mechanism.parameters) + len(mechanism.joints)
        assert len(set(Coordinates(mechanism.joints, ()).names)) == len(mechanism.joints)
