"""A MuJoCo model in the fit of several joints: its own steps, thousands of windows at a time.

The motion is the very simulation that runs behind the contract: the file's timestep, integrator, friction and contacts.
Each step gets the mean of the recorded effort over it; between steps positions are cubic, velocities straight.
"""

from __future__ import annotations

import math
import os
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.joint_fit import Windows
from pendulum_bags.identification.motion_model import DELAY, LAG, MotionModel, Timeline
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates, Joint
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_sim.foreign.model_source import ModelParameter, ModelSource
from pendulum_sim.foreign.mujoco_joints import find_joints
from pendulum_sim.foreign.mujoco_mapping import MujocoMapping

__all__ = ["LEAST", "MujocoMotion", "SimulationModel", "between_steps", "check_alone", "check_efforts"]

_CACHED = 64
"""Compiled models that are kept."""

_NO_LIMIT = 1e9
"""Largest effort of a file that states none: the recorded ones count [N m or N]."""

LEAST = 0.02
"""Share of its value in the file below which a positive parameter does not go."""


class MujocoMotion:
    """The joints of a model file, stepped by MuJoCo for many sets of numbers and windows at a time.

    Args:
        source: The file.
        mapping: What it does not define in the contract's terms.
        coordinates: Joints of the recordings; None for those of the file, or those of a pendulum where it has one.

    Raises:
        ParameterError: The file has other joints, or one that is not recorded moves too.
    """

    def __init__(
        self, source: ModelSource, mapping: MujocoMapping | None = None, coordinates: Coordinates | None = None
    ) -> None:
        self.source, self.mapping = source, mapping or MujocoMapping()
        self._mujoco = source.mujoco
        self.model = self._prepared(source.model)
        self.coordinates = coordinates or self._own_coordinates()
        limits = [_NO_LIMIT] * len(self.coordinates.driven)
        self._data = self._mujoco.MjData(self.model)
        self.joints, self._hangs = find_joints(
            self._mujoco, self.model, self._data, str(source.path), self.mapping, self.coordinates, limits, "the plant"
        )
        dofs = {dof for joint in self.joints for dof in (joint.dof, joint.driven_dof)}
        if self.model.nv > len(dofs):
            others = {int(self.model.dof_jntid[i]) for i in range(self.model.nv) if i not in dofs}
            listed = ", ".join(str(self.model.joint(i).name) or f"number {i}" for i in sorted(others))
            raise ParameterError(
                f"{source.path} has other joints that move, {listed}; expected recordings of all joints, or a file in "
                "which the others are locked"
            )
        threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._threads = [self._mujoco.MjData(self.model) for _ in range(threads)]
        self._rollout = source.rollout(threads)
        self._cache: OrderedDict[tuple[Any, ...], Any] = OrderedDict()
        self._columns()

    @property
    def timestep(self) -> float:
        """The file's timestep [s]."""
        return float(self.model.opt.timestep)

    @property
    def turned_by_gravity(self) -> tuple[str, ...]:
        """Names of the joints whose zero gravity shows."""
        data, rng = self._data, np.random.default_rng(0)
        found, at = [], rng.uniform(-1.0, 1.0, self.model.nq)

        def fall(qpos: Array) -> Array:
            self._mujoco.mj_resetData(self.model, data)
            data.qpos[:] = qpos
            self._mujoco.mj_forward(self.model, data)
            return np.array(data.qfrc_bias)

        for joint in self.joints:
            moved = at.copy()
            moved[joint.qpos] += 0.5
            if joint.joint.turns and np.any(np.abs(fall(moved) - fall(at)) > 1e-9):
                found.append(joint.joint.name)
        return tuple(found)

    def largest(self) -> list[float]:
        """Return the largest effort of each driven joint that the file lets through [N m or N]."""
        return [self.joints[i].limit for i in self.coordinates.driven]

    def inertia(self, joint: int) -> float:
        """Return the inertia that a joint of the file moves at its zero [kg m^2 or kg]."""
        return float(self.model.dof_M0[self.model.jnt_dofadr[joint]])

    def compiled(self, parameters: Sequence[ModelParameter], values: Array) -> Any:
        """Return the model with other numbers; None where MuJoCo refuses it."""
        key = (*(one.name for one in parameters), *values.tolist())
        if key not in self._cache:
            found = None
            with suppress(ParameterError):
                found = self._prepared(self.source.compile(parameters, values.tolist()))
            self._cache[key] = found
            if len(self._cache) > _CACHED:
                self._cache.popitem(last=False)
        return self._cache[key]

    def forget(self) -> None:
        """Drop all compiled models."""
        self._cache.clear()

    @property
    def lags(self) -> list[float]:
        """Return the time constant of the filter of each joint's actuator, 0 without one [s]."""
        model, h, found = self.model, self.timestep, []
        for joint in self.joints:
            actuator = joint.actuator
            lag = 0.0
            if actuator is not None and model.actuator_actadr[actuator] >= 0:
                lag = float(model.actuator_dynprm[actuator, 0])
                if model.actuator_dyntype[actuator] == int(self._mujoco.mjtDyn.mjDYN_FILTER) and lag > h:
                    # A step of Euler decays as an exact filter that is a little faster.
                    lag = -h / math.log1p(-h / lag)
            found.append(lag)
        return found

    def run(self, models: Sequence[Any], starts: Array, effort: Array, before: Array) -> Array:
        """Return motions, shape (c, w, s + 1, 2 n), of c models from starts (c, w, 2 n) under efforts (c, w, s, n).

        ``before`` is what the filters of the actuators hold at the start, as an effort, shape (c, w, n).
        """
        (c, w), steps, n = starts.shape[:2], effort.shape[2], len(self.joints)
        state = np.tile(self._rest, (c * w, 1))
        control = np.zeros((c * w, steps, self.model.nu + self.model.nv))
        for i, joint in enumerate(self.joints):
            q, v = starts[..., i].reshape(-1), starts[..., n + i].reshape(-1)
            q = joint.zero + joint.sign * q
            state[:, self._qpos[joint.qpos]] = q
            if joint.driven_dof != joint.dof:
                other = int(self.model.jnt_qposadr[self.model.dof_jntid[joint.driven_dof]])
                state[:, self._qpos[other]] = self.model.qpos0[other] + q - self.model.qpos0[joint.qpos]
            state[:, self._qvel[[joint.dof, joint.driven_dof]]] = joint.sign * v[:, None]
            drive = joint.sign * effort[..., i].reshape(c * w, steps)
            if joint.actuator is None:
                control[..., self.model.nu + joint.dof] += drive
                continue
            control[..., joint.control] = drive * joint.control_per_torque
            if (act := int(self.model.actuator_actadr[joint.actuator])) >= 0:
                held = before[..., i].reshape(-1)
                state[:, self._act[act]] = joint.sign * held * joint.control_per_torque
        spec = int(self._mujoco.mjtState.mjSTATE_CTRL) | int(self._mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        rows = [model for model in models for _ in range(w)] if len({*map(id, models)}) > 1 else models[0]
        found, _ = self._rollout.rollout(rows, self._threads, state, control, control_spec=spec)
        every = np.concatenate((state[:, None], found), axis=1)
        path = np.empty((c * w, steps + 1, 2 * n))
        for i, joint in enumerate(self.joints):
            path[..., i] = joint.sign * (every[..., self._qpos[joint.qpos]] - joint.zero)
            path[..., n + i] = joint.sign * every[..., self._qvel[joint.dof]]
        return path.reshape(c, w, steps + 1, 2 * n)

    def _prepared(self, model: Any) -> Any:
        # MuJoCo's own reset would hide that the simulation diverged; no sensor has an effect.
        bits = self._mujoco.mjtDisableBit
        model.opt.disableflags |= int(bits.mjDSBL_AUTORESET) | int(bits.mjDSBL_SENSOR)
        if self.mapping.timestep is not None:
            model.opt.timestep = self.mapping.timestep
        return model

    def _own_coordinates(self) -> Coordinates:
        model, kinds = self.model, self._mujoco.mjtJoint
        units = {int(kinds.mjJNT_HINGE): "rad", int(kinds.mjJNT_SLIDE): "m"}
        found = [(str(model.joint(i).name), units[int(model.jnt_type[i])]) for i in range(model.njnt)
                 if int(model.jnt_type[i]) in units]  # fmt: skip
        if len(found) < 2:
            return ONE_JOINT
        if not all(name for name, _ in found):
            raise ParameterError(f"{self.source.path} has joints without names; expected --plant, or a name for each")
        by_actuator = {int(model.actuator_trnid[i, 0]) for i in range(model.nactuator)}
        driven = [i for i, (name, _) in enumerate(found) if model.joint(name).id in by_actuator]
        joints = tuple(Joint(name, unit, unit == "rad") for name, unit in found)
        return Coordinates(joints, tuple(driven or range(len(joints))))

    def _columns(self) -> None:
        """Find the columns of MuJoCo's state, whose order is its own."""
        model, data, full = self.model, self._data, int(self._mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._mujoco.mj_resetData(model, data)
        self._rest = np.empty(self._mujoco.mj_stateSize(model, full))
        self._mujoco.mj_getState(model, data, self._rest, full)
        marked = np.empty_like(self._rest)
        places = []
        for name in ("qpos", "qvel", "act"):
            values = getattr(data, name)
            before = values.copy()
            values[:] = 1e6 + np.arange(values.size)
            self._mujoco.mj_getState(model, data, marked, full)
            places.append(np.array([int(np.flatnonzero(marked == 1e6 + i)[0]) for i in range(values.size)], dtype=int))
            values[:] = before
        self._qpos, self._qvel, self._act = places


@dataclass(frozen=True)
class SimulationModel(MotionModel):
    """Chosen numbers of a model file, and what the recordings add: offsets and a delay.

    Attributes:
        motion: The file.
        parameters: The chosen numbers, k of them.
        vector: Values, in the order of ``names``.
        limits: Domains that the caller gave, by name.
    """

    motion: MujocoMotion
    parameters: tuple[ModelParameter, ...]
    vector: Array
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        motion: MujocoMotion,
        parameters: Sequence[ModelParameter],
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> SimulationModel:
        """Return the model as the file has it."""
        rest = [0.0] * (2 * len(motion.joints) + 2)
        return cls(motion, tuple(parameters), np.array([*(one.value for one in parameters), *rest]), limits or {})

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Paths of the numbers, then offsets of efforts and angles, and the delay; a lag is always 0."""
        joints = self.coordinates.names
        extra = [f"{joint}.{key}" for key in ("effort_offset", "angle_offset") for joint in joints]
        return (*(one.name for one in self.parameters), *extra, DELAY, LAG)

    @property
    def coordinates(self) -> Coordinates:
        """The joints that are recorded."""
        return self.motion.coordinates

    @property
    def label(self) -> str:
        """Name of the file."""
        return self.motion.source.path.name

    @property
    def start(self) -> SimulationModel:
        """The model as the file has it."""
        return SimulationModel.of(self.motion, self.parameters, self.limits)

    @property
    def smooth(self) -> SimulationModel:
        """The model without the dry friction that is among its parameters."""
        return self.with_changes({one: 0.0 for one in self.names if one.endswith("frictionloss")})

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the positive numbers: masses, inertias, distances, gears."""
        return tuple(one.name for one in self.parameters if one.positive)

    @property
    def near(self) -> tuple[str, ...]:
        """Names of the sizes but inertias about a centre of mass, which may be a small part of what a joint moves."""
        return tuple(name for name in self.sizes if "/inertia" not in name)

    @cached_property
    def own_offsets(self) -> tuple[tuple[str, ...], ...]:
        """Offsets of the driven joints' efforts, and of the angles that gravity shows."""
        efforts = tuple(f"{joint}.effort_offset" for joint in self.coordinates.driven_names)
        angles = tuple(f"{joint}.angle_offset" for joint in self.motion.turned_by_gravity)
        return tuple(group for group in (efforts, angles) if group)

    def chosen(self, name: str) -> ModelParameter | None:
        """Return the number of a path; None for an offset or the delay."""
        return next((one for one in self.parameters if one.name == name), None)

    def with_vector(self, vector: Array) -> SimulationModel:
        """Return the model with other values."""
        return replace(self, vector=np.array(vector, dtype=float))

    def unit(self, name: str) -> str:
        """Return the unit of a parameter."""
        if (one := self.chosen(name)) is not None:
            return one.unit
        if name in {DELAY, LAG}:
            return "s"
        joint, _, key = name.rpartition(".")
        own = self.coordinates.joints[self.coordinates.names.index(joint)]
        return own.unit if key == "angle_offset" else own.effort_unit

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the domain of a parameter."""
        one = self.chosen(name)
        if name in self.limits:
            return self.limits[name]
        if one is None or one.signed:
            return -np.inf, np.inf
        return LEAST * one.value if one.positive else 0.0, np.inf

    def size(self, name: str) -> float:
        """Return a scale of a parameter, in its unit."""
        one = self.chosen(name)
        if one is None:
            return 0.01
        if one.value:
            return abs(one.value)
        return 0.1 * self.motion.inertia(one.joint) if one.joint >= 0 else 1e-3

    def fitted(self, *, offsets: bool = False, delay: bool = False, lag: bool = False) -> tuple[str, ...]:
        """Return the chosen numbers, with offsets and the delay where they are wanted."""
        names = [one.name for one in self.parameters]
        if offsets:
            driven = self.coordinates.driven_names
            names += [f"{one}.effort_offset" for one in driven] or [
                f"{one}.angle_offset" for one in self.motion.turned_by_gravity
            ]
        if self.coordinates.driven and delay:
            names.append(DELAY)
        return tuple(names)

    def held(self, free: Sequence[str]) -> str:
        """Return in a sentence what is not fitted."""
        held = [one.name for one in self.parameters if one.name not in free]
        also = f": of the chosen ones {', '.join(held)}" if held else ""
        return (
            f"All other numbers are those of {self.label}{also}. Where one is wrong, the fitted ones carry its error."
        )

    def motions(self, values: Array, data: Timeline, states: Array) -> Array:
        """Return motions, shape (c, w, l, 2 n), of values (c, parameters) and start states (c, w, 2 n)."""
        assert isinstance(data, Windows)
        n, h, first = len(self.coordinates.joints), self.motion.timestep, data.time[:, :1]
        steps = max(1, math.ceil(float((data.time[:, -1:] - first).max()) / h - 1e-6))
        grid = replace(data, time=first + h * np.arange(steps + 1))
        delays, which = np.unique(values[:, self.names.index(DELAY)], return_inverse=True)
        lines = np.array([grid.input(delay, 0.0) for delay in delays])
        push, zero = (values[:, len(self.parameters) + i * n : len(self.parameters) + (i + 1) * n] for i in range(2))
        effort = (lines[..., :n] + 0.5 * h * lines[..., n:])[which.reshape(-1)] + push[:, None, None]
        starts = states.copy()
        starts[..., :n] -= zero[:, None]
        models = [self.motion.compiled(self.parameters, row[: len(self.parameters)]) for row in values]
        before = np.zeros((len(values), len(first), n))
        for i, lag in enumerate(self.motion.lags):
            if lag > 0.0:
                held = np.array([grid.input(delay, lag)[:, 0, i] for delay in delays])
                before[..., i] = held[which.reshape(-1)] + push[:, i, None]
        path = self.motion.run([one or self.motion.model for one in models], starts, effort, before)
        found = between_steps(path, (data.time - first) / h, h)
        found[..., :n] += zero[:, None, None]
        found[[one is None for one in models]] = np.nan
        return found


def between_steps(path: Array, at: Array, h: float) -> Array:
    """Return a path, shape (c, w, s + 1, 2 n), at fractions of steps of h [s], shape (w, l): (c, w, l, 2 n)."""
    n = path.shape[-1] // 2
    k = np.clip(np.floor(at + 1e-6).astype(int), 0, path.shape[2] - 2)
    f = np.clip(at - k, 0.0, 1.0)[None, ..., None]
    rows = np.arange(len(at))[:, None]
    a, b = path[:, rows, k], path[:, rows, k + 1]
    rise = b[..., :n] - a[..., :n]
    early, late = h * a[..., n:] - rise, rise - h * b[..., n:]
    position = a[..., :n] + f * rise + f * (1.0 - f) * ((1.0 - f) * early + f * late)
    return np.concatenate((position, (1.0 - f) * a[..., n:] + f * b[..., n:]), axis=-1)


def check_efforts(motion: MujocoMotion, name: str, effort: Array) -> str | None:
    """Return that a file cannot give recorded efforts, shape (s, n), in a sentence; None where it can."""
    for index, limit in zip(motion.coordinates.driven, motion.largest(), strict=True):
        share = float(np.mean(np.abs(effort[:, index]) > 1.001 * limit))
        if share:
            joint = motion.coordinates.joints[index]
            return (
                f"{name}: the recorded effort of {joint.name} is above the {limit:.4g} {joint.effort_unit} that "
                f"{motion.source.path.name} lets through in {100.0 * share:.2g} % of the samples: it counts as that."
            )
    return None


def check_alone(motion: MujocoMotion, parameters: Sequence[ModelParameter]) -> None:
    """Refuse numbers that MuJoCo does not let change alone.

    Raises:
        DataError: MuJoCo refuses the file with a number that is a little smaller, or larger.
    """
    for one in parameters:
        for factor in (1.0 - 1e-3, 1.0 + 1e-3):
            try:
                motion.source.compile([one], [one.value * factor])
            except ParameterError as error:
                whole = one.name.rpartition("/")[0]
                raise DataError(f"{one.name} cannot change alone ({error}); expected {whole} as a whole") from error
