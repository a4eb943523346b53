"""A model of MuJoCo as a plant: any MJCF or URDF with a hinge to drive, or with the joints of a plant file.

Actuators, friction, integrator and timestep are the file's; a mapping file adds what is missing. A file of
``export_model`` needs none: joints with the contract's names have its zero and sign, and actuators of its names on them
take its commands.
"""

from __future__ import annotations

import copy
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.joints import ONE_JOINT, Vector
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant
from pendulum_sim.foreign.mujoco_joints import Hang, find_joints, place
from pendulum_sim.foreign.mujoco_mapping import MujocoMapping
from pendulum_sim.foreign.mujoco_model import import_mujoco, read_model
from pendulum_sim.foreign.mujoco_switches import CAUSES, switch_off
from pendulum_sim.stepping.mechanism_plant import MechanismState
from pendulum_sim.stepping.plant import check_start, command_within

__all__ = ["MujocoPlant", "load_mujoco_plant"]

PERIOD = 0.002
"""Default time between two states, unless the timestep is longer [s]."""


def load_mujoco_plant(
    path: str | Path,
    mapping: MujocoMapping | None = None,
    *,
    rate_hz: float = 0.0,
    effort_limit: float = 0.0,
    equation: PlantParameters | None = None,
) -> MujocoPlant:
    """Return the plant of an MJCF or URDF file.

    ``rate_hz`` 0 is 500 Hz, or that of a longer timestep; ``effort_limit`` is the largest torque if neither file nor
    mapping has one, 0 for none [N m]. ``equation`` is the plant of a model of several joints: their names and units,
    which are driven, and limits that the file lacks; None for a pendulum, whose equation is read off the file.

    Raises:
        ParameterError: MuJoCo is missing or refuses the file, or the file has no such joints that can be driven.
    """
    mujoco = import_mujoco()
    path = Path(path).expanduser()
    model, remarks = read_model(mujoco, path)
    plant = MujocoPlant(mujoco, model, mapping or MujocoMapping(), str(path), rate_hz, effort_limit, equation)
    plant.remarks += remarks
    return plant


class MujocoPlant:
    """Joints of a MuJoCo model as a plant; see :func:`load_mujoco_plant`.

    ``parameters`` are the given equation with the limits of the file, or the closest one of a pendulum, in commanded
    torque; ``remarks`` the automatic choices as text.
    """

    def __init__(
        self,
        mujoco: Any,
        model: Any,
        mapping: MujocoMapping,
        path: str,
        rate_hz: float,
        effort_limit: float,
        equation: PlantParameters | None = None,
    ) -> None:
        self._mujoco, self._model, self._path = mujoco, model, path
        self._data = mujoco.MjData(model)
        # MuJoCo's own reset would hide that the simulation diverged.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if mapping.timestep is not None:
            model.opt.timestep = mapping.timestep
        self.dt, self._substeps = self._choose_period(float(model.opt.timestep), rate_hz)
        coordinates = ONE_JOINT if equation is None else equation.coordinates
        limits, name = ((effort_limit,), "") if equation is None else (equation.effort_limits, equation.name)
        self._joints, hangs = find_joints(mujoco, model, self._data, path, mapping, coordinates, limits, name)
        self._driven = tuple(self._joints[i] for i in coordinates.driven)
        if equation is None:
            self.parameters = self._describe(hangs)
        else:
            found = {f"{each.joint.name}.effort_limit": each.limit for each in self._driven}
            self.parameters = equation.with_values(found)
        self.remarks = []
        for joint, (_, hanging) in zip(self._joints, hangs, strict=True):
            unit = joint.joint.unit
            through = f" through {joint.motor}, at most {joint.limit:g} {joint.unit}" if joint in self._driven else ""
            turned = ", turned round" if joint.sign < 0 else ""
            rest = joint.rest(partial(place, mujoco, model, self._data, self._joints, hangs, joint), hanging)
            self.remarks.append(
                f"joint {joint.name!r}{through}; its {joint.zero:.6g} {unit} are our 0{turned}; "
                f"it hangs at {rest:.6g} {unit}"
            )
        self.remarks.append(f"timestep {model.opt.timestep * 1e3:g} ms, {self._substeps} in a period")
        self._steps = 0
        self._still = (0.0,) * len(self._joints)
        self.reset(self._still, self._still)

    @property
    def description(self) -> str:
        """Engine and integrator, as text."""
        integrator = self._mujoco.mjtIntegrator(self._model.opt.integrator).name.removeprefix("mjINT_").lower()
        return f"mujoco {self._mujoco.__version__}, {integrator}"

    @property
    def state(self) -> MechanismState:
        """The present state."""
        return MechanismState(
            self._steps * self.dt,
            tuple(joint.position for joint in self._joints),
            tuple(joint.velocity for joint in self._joints),
            tuple(joint.effort for joint in self._joints),
        )

    def reset(self, position: Vector, velocity: Vector) -> MechanismState:
        """Restart as the file does, except for positions [rad or m] and velocities of the joints; motors follow."""
        for q, v in zip(position, velocity, strict=True):
            check_start(q, v)
        self._mujoco.mj_resetData(self._model, self._data)
        for joint, q, v in zip(self._joints, position, velocity, strict=True):
            joint.start(q, v)
        self._steps = 0
        self._mujoco.mj_forward(self._model, self._data)
        return self.state

    def step(self, effort: Vector, push: Vector) -> MechanismState:
        """Advance by one period under m commanded efforts, clamped to the limits, and n efforts on the joints.

        Raises:
            FaultError: MuJoCo met values that are not finite, or too large.
            ParameterError: An effort is not finite (nothing moves then).
        """
        data, commands = self._data, dict.fromkeys(self._joints, 0.0)
        pushed = dict(zip(self._joints, push, strict=True))
        for joint, wanted in zip(self._driven, effort, strict=True):
            commands[joint] = command_within(joint.limit, wanted, pushed[joint])
        for joint in self._joints:
            command_within(math.inf, 0.0, pushed[joint])
        for joint, command in commands.items():
            joint.drive(command, pushed[joint])
        self._mujoco.mj_step(self._model, data, self._substeps)
        self._steps += 1
        for warning in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL"):
            if data.warning[int(getattr(self._mujoco.mjtWarning, f"mjWARN_{warning}"))].number:
                raise FaultError(
                    f"MuJoCo met a value that is not finite or too large ({warning}) after "
                    f"{self._steps * self.dt:.3f} s; is a timestep of {self._model.opt.timestep * 1e3:g} ms too long?"
                )
        return self.state

    @property
    def switches(self) -> tuple[str, ...]:
        """Causes for :meth:`without`."""
        return CAUSES

    def without(self, causes: tuple[str, ...]) -> MujocoPlant:
        """Return a copy with the same joints, zeros and limits, and some causes switched off."""
        other = copy.copy(self)
        other._model = copy.copy(self._model)
        dofs = {dof for joint in self._joints for dof in (joint.dof, joint.driven_dof)}
        actuators = {joint.actuator for joint in self._driven if joint.actuator is not None}
        for cause in causes:
            other._substeps *= switch_off(self._mujoco, other._model, cause, dofs, actuators)
        other._data = self._mujoco.MjData(other._model)
        other._joints = tuple(copy.copy(joint) for joint in self._joints)
        other._driven = tuple(other._joints[self._joints.index(joint)] for joint in self._driven)
        for joint in other._joints:
            joint.use(other._model, other._data)
        other.reset(self._still, self._still)
        return other

    # --- contents of the file -------------------------------------------------------------------------------

    def _choose_period(self, timestep: float, rate_hz: float) -> tuple[float, int]:
        if not rate_hz:
            substeps = max(1, math.floor(PERIOD / timestep + 1e-9))
            return substeps * timestep, substeps
        steps = 1.0 / rate_hz / timestep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise ParameterError(
                f"rate_hz is {rate_hz:g} Hz, a period of {1e3 / rate_hz:.6g} ms; expected whole timesteps of "
                f"{self._path}, {timestep * 1e3:g} ms each: {1.0 / timestep:.6g} Hz or a part of it, or timestep in a "
                "mapping file"
            )
        return 1.0 / rate_hz, round(steps)

    def _describe(self, hangs: list[Hang]) -> PlantParameters:
        """Return the closest equation of a pendulum."""
        model, data, mujoco = self._model, self._data, self._mujoco
        ((weight, hanging),), (joint,) = hangs, self._joints
        place(mujoco, model, data, self._joints, hangs, joint, hanging)
        # In slow motion a motor behind a spring moves with the link.
        dofs = sorted({joint.dof, joint.driven_dof})
        inertia = 0.0
        for dof in dofs:
            one, masses = np.zeros(model.nv), np.zeros(model.nv)
            one[dof] = 1.0
            mujoco.mj_mulM(model, data, masses, one)
            inertia += float(masses[dof])
        damping = sum(float(model.dof_damping[i]) for i in dofs)
        lag = delay = 0.0
        if joint.actuator is not None:
            if model.actuator_dyntype[joint.actuator] != int(mujoco.mjtDyn.mjDYN_NONE):
                lag = float(model.actuator_dynprm[joint.actuator, 0])
            delay = float(model.actuator_delay[joint.actuator])
            # MuJoCo stores the motor's separately.
            damping += float(model.actuator_damping[joint.actuator]) * joint.gear**2
        gain = abs(joint.gain)
        return pendulum_plant(
            inertia=inertia / gain,
            damping=damping / gain,
            gravity=weight / gain,
            coulomb_friction=sum(float(model.dof_frictionloss[i]) for i in dofs) / gain,
            angle_offset=wrap(joint.sign * (hanging - joint.zero)),
            effort_limit=joint.limit,
            actuator_time_constant=lag,
            transport_delay=delay,
            name=Path(self._path).stem,
        )
