"""The fit model of a mechanism: what is free, what the motion can tell apart, one step and its derivatives.

In measured coordinates (q as the encoders say, u as recorded), for each joint i::

    M(q) q'' + c(q, v) + g(q) + D v = torque,   torque_i = u_i(t - d) + o_i - F_i sgn(v_i)

with u after a first-order lag, delay d and lag common to all motors, and F_i the Coulomb friction with true stiction.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.arrowhead import Prior
from pendulum_bags.identification.joint_kernel import motion_kernel
from pendulum_bags.identification.motion_model import DELAY, LAG, MotionModel, Timeline
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pack_joints

__all__ = ["DELAY", "LAG", "JointModel", "tellable"]

_SPREADS = {"length": 0.03, "rotor": 0.05}
"""Standard deviations of lengths and rotor inertias in the plant file, as shares of them: a ruler's, and that of a
catalogue's 10 %. The fit weighs them against the motion: a rotor that is held biases inertias, outside their intervals.
"""

_ORDER = ("kg m^2", "m", "kg")
"""Which of two parameters that the motion cannot tell apart is fitted: that of the unit that comes first here."""

_WEAK = 1e-3
"""Share of a parameter's own effect that must be left after the others have explained what they can."""


@dataclass(frozen=True)
class JointModel(MotionModel):
    """A mechanism with the numbers of a fit.

    Attributes:
        plant: The plant that names mechanism, joints and what is held.
        vector: Fit parameters, in the order of ``names``.
    """

    plant: PlantParameters
    vector: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names: the mechanism's own, dampings, then Coulomb frictions, torque offsets, angle offsets and the delay."""
        joints = self.plant.coordinates.names
        extra = [f"{joint}.{key}" for key in ("coulomb_friction", "effort_offset", "angle_offset") for joint in joints]
        return (*self.plant.mechanism.parameter_names, *extra, DELAY, LAG)

    @classmethod
    def of(cls, plant: PlantParameters) -> JointModel:
        """Return the model that a plant file makes."""
        joints = plant.joints
        zeros = [0.0] * (2 * len(joints) + 2)
        return cls(plant, np.array([*plant.packed, *(joint.coulomb_friction for joint in joints), *zeros]))

    @property
    def coordinates(self) -> Coordinates:
        """Joints of the plant."""
        return self.plant.coordinates

    @property
    def label(self) -> str:
        """Name of the plant."""
        return self.plant.name

    @property
    def start(self) -> JointModel:
        """The model that the plant file makes."""
        return JointModel.of(self.plant)

    @property
    def smooth(self) -> JointModel:
        """The model without dry friction."""
        return self.with_changes({f"{joint}.coulomb_friction": 0.0 for joint in self.coordinates.names})

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the mechanism's own parameters that motion tells apart."""
        return tellable(self.plant)

    def with_vector(self, vector: Array) -> JointModel:
        """Return the model with other values."""
        return JointModel(self.plant, np.array(vector, dtype=float))

    def unit(self, name: str) -> str:
        """Return the unit of a parameter."""
        for spec in self.plant.mechanism.parameters:
            if spec.name == name:
                return spec.unit
        if name in {DELAY, LAG}:
            return "s"
        joint, _, key = name.partition(".")
        own = self.plant.coordinates.joints[self.plant.coordinates.names.index(joint)]
        return {"damping": own.damping_unit, "angle_offset": own.unit}.get(key, own.effort_unit)

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the domain of a parameter."""
        for spec in self.plant.mechanism.parameters:
            if spec.name == name:
                return 0.02 * self.plant.value(name) if spec.exclusive_minimum else 0.0, np.inf
        return 0.0 if name.endswith(("damping", "coulomb_friction", LAG)) else -np.inf, np.inf

    def prior(self, names: Sequence[str]) -> Prior:
        """Return what the plant file knows of some parameters."""
        start = self.start
        known = np.array([start[name] for name in names])
        return Prior(known, np.array([self.spread(name) for name in names]) ** -2.0)

    def spread(self, name: str) -> float:
        """Return the standard deviation with which the plant file knows a parameter; inf where it does not count."""
        return next((s * self.plant.value(name) for part, s in _SPREADS.items() if part in name), np.inf)

    def size(self, name: str) -> float:
        """Return a scale of a parameter, in its unit, so that steps and ranks do not depend on units."""
        value = abs(self.start[name])
        if value > 0.0:
            return value
        return {DELAY: 0.01, LAG: 1e-3}.get(name, 0.01 if name.endswith("offset") else 1e-3)

    def fitted(self, *, offsets: bool = False, delay: bool = False, lag: bool = False) -> tuple[str, ...]:
        """Return the names that are free, of those that the motion can tell apart."""
        joints = self.plant.coordinates
        names = [*tellable(self.plant), *(f"{joint}.damping" for joint in joints.names)]
        names += [f"{joint}.coulomb_friction" for joint in joints.names]
        if offsets:
            names += [f"{joint}.effort_offset" for joint in joints.driven_names]
        if joints.driven:
            names += [name for name, wanted in ((DELAY, delay), (LAG, lag)) if wanted]
        return tuple(names)

    def held(self, free: Sequence[str]) -> str:
        """Return in a sentence which of the mechanism's own parameters are not free."""
        held = [spec.name for spec in self.plant.mechanism.parameters if spec.name not in free]
        return (
            "Held at the values of the plant file, as known or since no motion tells them from the others: "
            f"{', '.join(held)}. Where one of them is wrong, the fitted ones carry its error."
        )

    @property
    def own_offsets(self) -> tuple[tuple[str, ...], ...]:
        """Offsets that each recording may have of its own: of the efforts, and of the angles that gravity shows."""
        joints, plant = self.plant.coordinates, self.plant
        efforts = tuple(f"{joint}.effort_offset" for joint in joints.driven_names)
        rng, rest = np.random.default_rng(0), (0.0,) * len(plant.joints)
        q = rng.uniform(-3.0, 3.0, len(plant.joints))
        still = np.array(plant.acceleration(tuple(q), rest, rest))
        angles = tuple(
            f"{joint.name}.angle_offset"
            for joint, step in zip(joints.joints, np.eye(q.size), strict=True)
            if joint.turns
            and np.any(np.abs(np.subtract(plant.acceleration(tuple(q + step), rest, rest), still)) > 1e-9)
        )
        return tuple(group for group in (efforts, angles) if group)

    def identified(self, free: Sequence[str], name: str) -> PlantParameters:
        """Return the plant that has the values of what was fitted; a delay below 0 and offsets are left out.

        Raises:
            ParameterError: No body has these masses and inertias.
        """
        joints = tuple(replace(joint, static_friction=None) for joint in self.plant.joints)
        plant = replace(self.plant, joints=joints, name=name)
        changes = {each: self[each] for each in free if each in plant.specs}
        for joint in plant.coordinates.driven_names:
            if DELAY in free:
                changes[f"{joint}.transport_delay"] = max(self[DELAY], 0.0)
            if LAG in free:
                changes[f"{joint}.{LAG}"] = self[LAG]
        return plant.with_values(changes)

    def motions(self, values: Array, data: Timeline, states: Array) -> Array:
        """Return motions, shape (c, w, l, 2 n), of values (c, parameters) and start states (c, w, 2 n)."""
        pairs, which = np.unique(values[:, self.index((DELAY, LAG))], axis=0, return_inverse=True)
        drive = np.array([data.input(*pair) for pair in pairs])
        path = np.empty((len(values), *data.time.shape, states.shape[-1]))
        steps, starts = np.diff(data.time, axis=1), np.ascontiguousarray(states)
        run = motion_kernel(self.plant.mechanism.name)
        run(*self.tables(values), drive, which.reshape(-1), steps, starts, path)
        return path

    def tables(self, values: Array) -> tuple[Array, Array, Array, Array]:
        """Return the arguments of :func:`motion_kernel` for c sets of values, shape (c, parameters)."""
        n, own = len(self.plant.joints), len(self.plant.mechanism.parameter_names)
        friction, offset, zero = (values[:, own + i * n : own + (i + 1) * n] for i in range(3))
        table = np.tile(np.array(pack_joints(self.plant)), (len(values), 1, 1))
        # In the fit breakaway is the friction while sliding, and the lag has been applied to the input.
        table[:, 0] = table[:, 1] = friction
        table[:, 5] = 0.0
        arrays = (values[:, :own], table, offset, zero)
        return tuple(np.ascontiguousarray(array) for array in arrays)  # type: ignore[return-value]


@lru_cache(maxsize=16)
def tellable(plant: PlantParameters) -> tuple[str, ...]:
    """Return the mechanism's own parameters that any motion under known efforts tells apart; the others are held.

    The acceleration's derivatives at random states show which parameters do the same. Of those, an inertia is fitted
    rather than a centre of mass, that rather than a mass, and that rather than a length or a rotor. Gravity, gears and
    rotors of no inertia are held.

    Source:
        Gautier and Khalil, Direct calculation of minimum set of inertial parameters of serial robots, IEEE Trans.
        Robotics and Automation 6(3), 1990 (base parameters; by random states: Gautier 1991).
    """
    model = JointModel.of(plant)
    own = [spec for spec in plant.mechanism.parameters if spec.unit in _ORDER and model.spread(spec.name) > 0.0]
    own.sort(key=lambda spec: (model.spread(spec.name) < np.inf, _ORDER.index(spec.unit)))
    damping = list(plant.mechanism.parameter_names[len(plant.mechanism.parameters) :])
    count = len(plant.joints)
    forward = in_arithmetic(plant.mechanism.forward, cmath)
    rng = np.random.default_rng(0)
    largest = float(np.max(plant.effort_limits)) if plant.actuators else 1.0
    samples = []
    for _ in range(80):
        q, v = tuple(rng.uniform(-3.0, 3.0, count)), tuple(rng.normal(0.0, 5.0, count))
        drive = np.zeros(count)
        drive[list(plant.coordinates.driven)] = rng.normal(0.0, largest, len(plant.actuators))
        values = np.array(complex_step(lambda *p, q=q, v=v, u=tuple(drive): forward(q, v, u, p), plant.packed))
        samples.append(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12))
    table = np.concatenate(samples)
    kept: list[str] = []
    basis = np.linalg.qr(table[:, model.index(damping)])[0] if damping else np.zeros((len(table), 0))
    for name in (spec.name for spec in own):
        column = table[:, model.names.index(name)] * model.size(name)
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > _WEAK * float(np.linalg.norm(column)) and np.linalg.norm(column) > 1e-9:
            kept.append(name)
            basis = np.column_stack((basis, rest / np.linalg.norm(rest)))
    return tuple(spec.name for spec in plant.mechanism.parameters if spec.name in kept)
