"""The fit model of a mechanism: what is free, what the motion can tell apart, one step and its derivatives.

In measured coordinates (q as the encoders say, u as recorded), for each joint i::

    M(q) q'' + c(q, v) + g(q) + D v = torque,   torque_i = u_i(t - d) + o_i - F_i tanh(v_i / w)

with the delay d common to all motors, F_i the Coulomb friction and w = 0.05 rad/s (or m/s), which smooths it inside the
fit alone. One step is the classical Runge-Kutta method under the mean of the input over the step; derivatives of the
equation are those of casadi's expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi
import numpy as np

from pendulum_bags.arrays import Array
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["DELAY", "MechanismModel", "tellable"]

DELAY = "delay"
"""Time from the recorded effort to its effect, negative where the effort is recorded late [s]."""

_SMOOTH = 0.05
"""Velocity over which the smoothed Coulomb friction changes sign [rad/s or m/s]."""

_ORDER = ("kg m^2", "m", "kg")
"""Which of two parameters that the motion cannot tell apart is fitted: that of the unit that comes first here."""

_WEAK = 1e-3
"""Share of a parameter's own effect that must be left after the others have explained what they can."""


@dataclass(frozen=True)
class MechanismModel:
    """A mechanism with the numbers of a fit.

    Attributes:
        plant: The plant that names mechanism, joints and what is held.
        values: Fit parameters, in the order of ``names``.
    """

    plant: MechanismParameters
    values: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names: the mechanism's own, dampings, then Coulomb frictions, torque offsets, angle offsets and the delay."""
        joints = self.plant.coordinates.names
        extra = [f"{joint}.{key}" for key in ("coulomb_friction", "effort_offset", "angle_offset") for joint in joints]
        return (*self.plant.mechanism.parameter_names, *extra, DELAY)

    @classmethod
    def of(cls, plant: MechanismParameters) -> MechanismModel:
        """Return the model that a plant file makes."""
        joints = plant.joints
        zeros = [0.0] * (2 * len(joints) + 1)
        return cls(plant, np.array([*plant.packed, *(joint.coulomb_friction for joint in joints), *zeros]))

    def index(self, names: Sequence[str]) -> list[int]:
        """Return where some parameters are."""
        own = self.names
        return [own.index(name) for name in names]

    def __getitem__(self, name: str) -> float:
        """Return a value by name."""
        return float(self.values[self.names.index(name)])

    def with_values(self, values: Array) -> MechanismModel:
        """Return the model with other numbers."""
        return MechanismModel(self.plant, np.array(values, dtype=float))

    def unit(self, name: str) -> str:
        """Return the unit of a parameter."""
        for spec in self.plant.mechanism.parameters:
            if spec.name == name:
                return spec.unit
        if name == DELAY:
            return "s"
        joint, _, key = name.partition(".")
        own = self.plant.coordinates.joints[self.plant.coordinates.names.index(joint)]
        return {"damping": own.damping_unit, "angle_offset": own.unit}.get(key, own.effort_unit)

    def lowest(self, name: str) -> float:
        """Return the least value that a parameter may take."""
        for spec in self.plant.mechanism.parameters:
            if spec.name == name:
                return 0.02 * self.plant.value(name) if spec.exclusive_minimum else 0.0
        return 0.0 if name.endswith(("damping", "coulomb_friction")) else -np.inf

    def size(self, name: str) -> float:
        """Return a scale of a parameter, in its unit, so that steps and ranks do not depend on units."""
        value = abs(float(MechanismModel.of(self.plant)[name]))
        if value > 0.0:
            return value
        return {DELAY: 0.01}.get(name, 0.01 if name.endswith("offset") else 1e-3)

    def fitted(self, *, offsets: bool = False, zeros: bool = False, delay: bool = False) -> tuple[str, ...]:
        """Return the names that are free, of those that the motion can tell apart."""
        joints = self.plant.coordinates
        names = [*tellable(self.plant), *(f"{joint}.damping" for joint in joints.names)]
        names += [f"{joint}.coulomb_friction" for joint in joints.names]
        if offsets:
            names += [f"{joint}.effort_offset" for joint in joints.driven_names]
        if zeros:
            names += [f"{joint.name}.angle_offset" for joint in joints.joints if joint.turns]
        return (*names, DELAY) if delay and joints.driven else tuple(names)


@lru_cache(maxsize=16)
def tellable(plant: MechanismParameters) -> tuple[str, ...]:
    """Return the mechanism's own parameters that any motion under known efforts tells apart; the others are held.

    The acceleration's derivatives at random states show which parameters do the same. Of those, an inertia is fitted
    rather than a centre of mass, and that rather than a mass. What a ruler tells (lengths of links, gravity, gears) is
    held.

    Source:
        Gautier and Khalil, Direct calculation of minimum set of inertial parameters of serial robots, IEEE Trans.
        Robotics and Automation 6(3), 1990 (base parameters; by random states: Gautier 1991).
    """
    model = MechanismModel.of(plant)
    own = [spec for spec in plant.mechanism.parameters if _free(spec.name, spec.unit)]
    names = [spec.name for spec in sorted(own, key=lambda spec: _ORDER.index(spec.unit))]
    damping = list(plant.mechanism.parameter_names[len(plant.mechanism.parameters) :])
    count = len(plant.joints)
    x, u, p = casadi.SX.sym("x", 2 * count), casadi.SX.sym("u", count), casadi.SX.sym("p", len(model.names))
    found = casadi.jacobian(_rate(model, x, u, p)[count:], p)
    rows = casadi.Function("rows", [x, u, p], [casadi.densify(found)])
    rng = np.random.default_rng(0)
    largest = float(np.max(plant.effort_limits)) if plant.actuators else 1.0
    samples = []
    for _ in range(80):
        state = np.concatenate((rng.uniform(-3.0, 3.0, count), rng.normal(0.0, 5.0, count)))
        drive = np.zeros(count)
        drive[list(plant.coordinates.driven)] = rng.normal(0.0, largest, len(plant.actuators))
        values = rows(state, drive, model.values).full()
        samples.append(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12))
    table = np.concatenate(samples)
    kept: list[str] = []
    basis = np.linalg.qr(table[:, model.index(damping)])[0] if damping else np.zeros((len(table), 0))
    for name in names:
        column = table[:, model.names.index(name)] * model.size(name)
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > _WEAK * float(np.linalg.norm(column)) and np.linalg.norm(column) > 1e-9:
            kept.append(name)
            basis = np.column_stack((basis, rest / np.linalg.norm(rest)))
    return tuple(spec.name for spec in plant.mechanism.parameters if spec.name in kept)


def _free(name: str, unit: str) -> bool:
    return unit in _ORDER and not name.startswith("rotor") and not (unit == "m" and "centre" not in name)


def _rate(model: MechanismModel, x: Any, u: Any, p: Any) -> Any:
    """Return the time derivative of (q, v) as casadi's expression."""
    plant = model.plant
    count = len(plant.joints)
    at = {name: p[i] for i, name in enumerate(model.names)}
    joints = plant.coordinates.names
    q = [x[i] - at[f"{joint}.angle_offset"] for i, joint in enumerate(joints)]
    v = [x[count + i] for i in range(count)]
    torque = [
        u[i] + at[f"{joint}.effort_offset"] - at[f"{joint}.coulomb_friction"] * casadi.tanh(v[i] / _SMOOTH)
        for i, joint in enumerate(joints)
    ]
    forward = in_arithmetic(plant.mechanism.forward, casadi)
    own = [p[i] for i in range(len(plant.mechanism.parameter_names))]
    return casadi.vertcat(*v, *forward(q, v, torque, own))


@lru_cache(maxsize=16)
def step_functions(plant: MechanismParameters, free: tuple[str, ...]) -> tuple[Any, Any]:
    """Return (x, u, h, p) -> next state, and (x, u, slope, p) -> d rate / d(x, free) with slope = du/d delay."""
    model = MechanismModel.of(plant)
    count = len(plant.joints)
    x, u, h = casadi.SX.sym("x", 2 * count), casadi.SX.sym("u", count), casadi.SX.sym("h")
    slope, p = casadi.SX.sym("slope", count), casadi.SX.sym("p", len(model.names))
    at = x
    first = _rate(model, at, u, p)
    second = _rate(model, at + 0.5 * h * first, u, p)
    third = _rate(model, at + 0.5 * h * second, u, p)
    fourth = _rate(model, at + h * third, u, p)
    following = at + h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    by_x, by_u, by_p = (casadi.jacobian(first, symbol) for symbol in (x, u, p))
    by_p[:, model.names.index(DELAY)] = by_u @ slope
    columns = by_p[:, model.index(free)] if free else casadi.SX(2 * count, 0)
    forward = casadi.Function("forward", [x, u, h, p], [following])
    derivative = casadi.Function("derivative", [x, u, slope, p], [casadi.densify(by_x), casadi.densify(columns)])
    return forward, derivative
