"""A model of MuJoCo as a plant: any MJCF or URDF with one hinge to drive.

Actuators, friction, integrator and timestep are the file's; a mapping file adds what is missing. A file of
``export_model`` needs none: a joint with the contract's name has its zero and sign, and an actuator ``effort`` on it
takes the contract's command.
"""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant
from pendulum_msgs_py.programs.extras import how_to_install
from pendulum_sim.foreign.mujoco_mapping import NO_ACTUATOR, MujocoMapping
from pendulum_sim.foreign.mujoco_model import read_model
from pendulum_sim.foreign.mujoco_switches import CAUSES, switch_off
from pendulum_sim.stepping.plant import PlantState, check_start, command_within

__all__ = ["MujocoPlant", "load_mujoco_plant"]

CONTRACT_ACTUATOR = "effort"
PERIOD = 0.002
"""Default time between two states, unless the timestep is longer [s]."""
_ANGLES = 24
_ROUNDING = 1e-12
_REST_ANGLES = 721
_BISECTIONS = 60


def load_mujoco_plant(
    path: str | Path, mapping: MujocoMapping | None = None, *, rate_hz: float = 0.0, effort_limit: float = 0.0
) -> MujocoPlant:
    """Return the plant of an MJCF or URDF file.

    ``rate_hz`` 0 is 500 Hz, or that of a longer timestep; ``effort_limit`` is the largest torque if neither file nor
    mapping has one, 0 for none [N m].

    Raises:
        ParameterError: MuJoCo is missing or refuses the file, or the file has no hinge that can be driven.
    """
    mujoco = _import_mujoco()
    path = Path(path).expanduser()
    if not path.is_file():
        raise ParameterError(f"model {path} does not exist; expected an MJCF or URDF file")
    model, remarks = read_model(mujoco, path)
    plant = MujocoPlant(mujoco, model, mapping or MujocoMapping(), str(path), rate_hz, effort_limit)
    plant.remarks += remarks
    return plant


def _import_mujoco() -> Any:
    # Imported late: it takes 60 MB.
    try:
        import mujoco
    except ImportError as error:
        raise ParameterError(how_to_install(error) or f"MuJoCo cannot be imported: {error}") from error
    # It would write warnings to a file in the working folder; they are raised here as errors.
    mujoco.set_mju_user_warning(lambda _text: None)
    return mujoco


class MujocoPlant:
    """A hinge of a MuJoCo model as a plant; see :func:`load_mujoco_plant`.

    ``parameters`` are the closest equation of a pendulum, in commanded torque; ``remarks`` the automatic choices as
    text.
    """

    def __init__(
        self, mujoco: Any, model: Any, mapping: MujocoMapping, path: str, rate_hz: float, effort_limit: float
    ) -> None:
        self._mujoco, self._model, self._path = mujoco, model, path
        self._data = mujoco.MjData(model)
        # MuJoCo's own reset would hide that the simulation diverged.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if mapping.timestep is not None:
            model.opt.timestep = mapping.timestep
        self.dt, self._substeps = self._choose_period(float(model.opt.timestep), rate_hz)
        joint = self._choose_joint(mapping.joint)
        self._qpos, self._dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        name = self._name("joint", joint)
        self._actuator = self._choose_actuator(mapping.actuator, joint)
        if self._actuator is not None:
            # An actuator may have several controls.
            self._control = int(model.actuator_ctrladr[self._actuator])
            self._gear = float(model.actuator_gear[model.actuator_outadr[self._actuator], 0])
        self._driven = self._dof if self._actuator is None else self._driven_dof(self._actuator)
        self._driven_qpos = self._qpos if self._driven == self._dof else self._qpos_of(self._driven)
        self._sign = mapping.sign
        per_control = 1.0 if self._actuator is None else self._torque_per_control(self._actuator)
        of_contract = (
            name == JOINT and self._actuator is not None and self._name("actuator", self._actuator) == CONTRACT_ACTUATOR
        )
        self._control_per_torque = mapping.control_per_torque or (1.0 if of_contract else 1.0 / per_control)
        gain = per_control * self._control_per_torque
        weight, hanging = self._weight()
        # Removes the fit's rounding, and -pi.
        hanging = 0.0 if abs(hanging) < _ROUNDING else hanging
        hanging = math.pi if abs(abs(hanging) - math.pi) < _ROUNDING else hanging
        if mapping.zero is not None:
            self._zero = mapping.zero
        else:
            self._zero = 0.0 if name == JOINT else self._rest(hanging)
        limit = self._limit(mapping.effort_limit, effort_limit, joint)
        self.parameters = self._describe(weight, hanging, gain, limit)
        driven = (
            "the joint itself" if self._actuator is None else f"actuator {self._name('actuator', self._actuator)!r}"
        )
        turned = ", turned round" if self._sign < 0 else ""
        angles = f"its {self._zero:.6g} rad are our 0{turned}; it hangs at {self._rest(hanging):.6g} rad"
        self.remarks = [
            f"joint {name!r} through {driven}, at most {limit:g} N m; {angles}",
            f"timestep {model.opt.timestep * 1e3:g} ms, {self._substeps} in a period",
        ]
        self._steps = 0
        self.reset()

    @property
    def description(self) -> str:
        """Engine and integrator, as text."""
        integrator = self._mujoco.mjtIntegrator(self._model.opt.integrator).name.removeprefix("mjINT_").lower()
        return f"mujoco {self._mujoco.__version__}, {integrator}"

    @property
    def state(self) -> PlantState:
        """The present state."""
        data = self._data
        theta = self._sign * (float(data.qpos[self._qpos]) - self._zero)
        if self._driven != self._dof:
            # Behind a motor's spring a sensor at the joint measures the spring.
            effort = float(data.qfrc_spring[self._dof])
        elif self._actuator is None:
            effort = float(data.qfrc_applied[self._dof]) - self._sign * self._push
        else:
            effort = float(data.qfrc_actuator[self._dof])
        return PlantState(self._steps * self.dt, theta, self._sign * float(data.qvel[self._dof]), self._sign * effort)

    def reset(self, theta: float = 0.0, theta_dot: float = 0.0) -> PlantState:
        """Restart as the file does, except for the joint's angle [rad] and velocity [rad/s]; a motor follows."""
        check_start(theta, theta_dot)
        model, data = self._model, self._data
        self._mujoco.mj_resetData(model, data)
        angle = self._zero + self._sign * theta
        data.qpos[self._qpos] = angle
        data.qvel[self._dof] = self._sign * theta_dot
        if self._driven != self._dof:
            data.qpos[self._driven_qpos] += angle - model.qpos0[self._qpos]
            data.qvel[self._driven] = self._sign * theta_dot
        self._steps = 0
        self._push = 0.0
        self._mujoco.mj_forward(model, data)
        return self.state

    def step(self, effort: float, push: float = 0.0) -> PlantState:
        """Advance by one period under a commanded torque, clamped to the limit, and a torque on the link [N m].

        Raises:
            FaultError: MuJoCo met values that are not finite, or too large.
            ParameterError: A torque is not finite (nothing moves then).
        """
        data = self._data
        command = command_within(self.parameters.effort_limit, effort, push)
        self._push = push
        applied = push
        if self._actuator is None:
            applied += command
        else:
            data.ctrl[self._control] = self._sign * command * self._control_per_torque
        data.qfrc_applied[self._dof] = self._sign * applied
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
        """Return a copy with the same joint, zero and limit, and some causes switched off."""
        other = copy.copy(self)
        other._model = copy.copy(self._model)
        dofs = {self._dof, self._driven}
        for cause in causes:
            other._substeps *= switch_off(self._mujoco, other._model, cause, dofs, self._actuator)
        other._data = self._mujoco.MjData(other._model)
        other.reset()
        return other

    # --- contents of the file -------------------------------------------------------------------------------

    def _name(self, kind: str, index: int) -> str:
        return str(getattr(self._model, kind)(index).name) or f"number {index}"

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

    def _choose_joint(self, wanted: str) -> int:
        hinge = int(self._mujoco.mjtJoint.mjJNT_HINGE)
        hinges = [i for i in range(self._model.njnt) if self._model.jnt_type[i] == hinge]
        names = {self._name("joint", i): i for i in hinges}
        listed = ", ".join(names) or "none"
        if wanted:
            if wanted not in names:
                raise ParameterError(f"{self._path} has no hinge {wanted!r}; expected one of its hinges: {listed}")
            return names[wanted]
        if JOINT in names:
            return names[JOINT]
        if len(hinges) != 1:
            raise ParameterError(
                f"{self._path} has {len(hinges)} hinges ({listed}); expected one, or joint in a mapping file"
            )
        return hinges[0]

    def _choose_actuator(self, wanted: str, joint: int) -> int | None:
        model = self._model
        if wanted == NO_ACTUATOR:
            return None
        names = {self._name("actuator", i): i for i in range(model.nactuator)}
        if wanted:
            if wanted not in names:
                listed = ", ".join(names) or "none"
                raise ParameterError(f"{self._path} has no actuator {wanted!r}; expected none or one of: {listed}")
            return names[wanted]
        joints = {int(self._mujoco.mjtTrn.mjTRN_JOINT), int(self._mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
        on_joint = [
            i
            for i in range(model.nactuator)
            if model.actuator_trntype[i] in joints and model.actuator_trnid[i, 0] == joint
        ]
        if not on_joint and self._name("joint", joint) == JOINT and CONTRACT_ACTUATOR in names:
            # This project's export of a motor behind a spring.
            return names[CONTRACT_ACTUATOR]
        if len(on_joint) == 1 or not names:
            return on_joint[0] if on_joint else None
        there = f"{len(on_joint)} actuators on" if on_joint else "no actuator on"
        raise ParameterError(
            f"{self._path} has {there} joint {self._name('joint', joint)!r}; expected actuator in a mapping file: "
            f"none, or one of {', '.join(names)}"
        )

    def _driven_dof(self, actuator: int) -> int:
        kinds = {int(self._mujoco.mjtTrn.mjTRN_JOINT), int(self._mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
        joint = int(self._model.actuator_trnid[actuator, 0])
        hinge = int(self._mujoco.mjtJoint.mjJNT_HINGE)
        if self._model.actuator_trntype[actuator] not in kinds or self._model.jnt_type[joint] != hinge:
            raise ParameterError(
                f"actuator {self._name('actuator', actuator)!r} of {self._path} drives no hinge; expected one that "
                "does, or actuator: none in a mapping file"
            )
        return int(self._model.jnt_dofadr[joint])

    def _qpos_of(self, dof: int) -> int:
        return int(self._model.jnt_qposadr[self._model.dof_jntid[dof]])

    def _torque_per_control(self, actuator: int) -> float:
        model, mujoco = self._model, self._mujoco
        torque = self._gear * float(model.actuator_gainprm[actuator, 0])
        lags = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
        makes_torque = (
            model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
            and not np.any(model.actuator_biasprm[actuator])
            and model.actuator_dyntype[actuator] in {int(lag) for lag in lags}
            and torque != 0.0
        )
        if not makes_torque:
            raise ParameterError(
                f"actuator {self._name('actuator', actuator)!r} of {self._path} is no source of torque (a servo, a "
                "muscle?); expected a motor, or actuator: none in a mapping file"
            )
        return torque

    def _limit(self, of_mapping: float | None, of_user: float, joint: int) -> float:
        model, actuator = self._model, self._actuator
        limits = []
        if actuator is not None:
            per_command = abs(self._control_per_torque)
            per_force = abs(self._torque_per_control(actuator) * self._control_per_torque / self._gear)
            for limited, bounds, per in (
                (model.actuator_ctrllimited[self._control], model.actuator_ctrlrange[self._control], per_command),
                (model.actuator_actlimited[actuator], model.actuator_actrange[actuator], per_command),
                (model.actuator_forcelimited[actuator], model.actuator_forcerange[actuator], per_force),
            ):
                if limited and not bounds[0] < 0.0 < bounds[1]:
                    low, high = sorted(float(bound) / per for bound in bounds)
                    raise ParameterError(
                        f"actuator {self._name('actuator', actuator)!r} of {self._path} gives {low:g} to {high:g} N m; "
                        "expected torque both ways, or actuator: none and effort_limit in a mapping file"
                    )
                if limited:
                    limits.append(_smaller(bounds) / per)
        if self._driven == self._dof and model.jnt_actfrclimited[joint] and (actuator is not None or not of_mapping):
            limits.append(_smaller(model.jnt_actfrcrange[joint]))
        known = min(limits, default=math.inf)
        if of_mapping is not None and of_mapping > known:
            raise ParameterError(
                f"effort_limit is {of_mapping:g} N m, the actuator of {self._path} gives {known:g} N m; expected at "
                "most that, or actuator: none for torque on the joint itself"
            )
        limit = min(known, of_mapping or of_user or known)
        if not (math.isfinite(limit) and limit > 0.0):
            raise ParameterError(
                f"{self._path} has no limit of torque at its joint; expected effort_limit as a parameter or in a "
                "mapping file"
            )
        return limit

    def _put(self, angle: float) -> None:
        """Put the joint, with a motor, at rest at an angle of the file's."""
        model, data = self._model, self._data
        self._mujoco.mj_resetData(model, data)
        data.qpos[self._qpos] = angle
        if self._driven != self._dof:
            data.qpos[self._driven_qpos] += angle - model.qpos0[self._qpos]
        self._mujoco.mj_forward(model, data)

    def _weight(self) -> tuple[float, float]:
        """Return G and q_0 of a weight G sin(q - q_0), in the file's angle and torque."""
        data = self._data
        angles = np.linspace(-math.pi, math.pi, _ANGLES, endpoint=False)
        torques = np.empty(_ANGLES)
        for i, angle in enumerate(angles):
            self._put(angle)
            torques[i] = data.qfrc_bias[self._dof] - data.qfrc_gravcomp[self._dof]
        basis = np.stack([np.sin(angles), np.cos(angles)], axis=1)
        (a, b), *_ = np.linalg.lstsq(basis, torques, rcond=None)
        if float(np.max(np.abs(torques))) < 1e-9:
            return 0.0, float(self._model.qpos0[self._qpos])
        return float(math.hypot(a, b)), math.atan2(-b, a)

    def _rest(self, hanging: float) -> float:
        """Return where the joint rests: hanging, unless a spring pulls it elsewhere."""

        def torque(angle: float) -> float:
            self._put(angle)
            return float(data.qfrc_spring[self._dof] - data.qfrc_bias[self._dof] + data.qfrc_gravcomp[self._dof])

        data = self._data
        self._put(hanging)
        if not np.any(self._model.jnt_stiffness[[self._model.dof_jntid[self._dof]]]):
            return hanging
        angles = hanging + np.linspace(-math.pi, math.pi, _REST_ANGLES)
        torques = [torque(float(angle)) for angle in angles]
        falls = [i for i in range(len(angles) - 1) if torques[i] >= 0.0 > torques[i + 1]]
        if not falls:
            return hanging
        nearest = min(falls, key=lambda i: abs(angles[i] - hanging))
        low, high = float(angles[nearest]), float(angles[nearest + 1])
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if torque(middle) >= 0.0 else (low, middle)
        rest = 0.5 * (low + high)
        return 0.0 if abs(rest) < _ROUNDING else rest

    def _describe(self, weight: float, hanging: float, gain: float, limit: float) -> PlantParameters:
        model, data, mujoco = self._model, self._data, self._mujoco
        self._put(hanging)
        # In slow motion a motor behind a spring moves with the link.
        dofs = sorted({self._dof, self._driven})
        inertia = 0.0
        for dof in dofs:
            one, masses = np.zeros(model.nv), np.zeros(model.nv)
            one[dof] = 1.0
            mujoco.mj_mulM(model, data, masses, one)
            inertia += float(masses[dof])
        damping = sum(float(model.dof_damping[i]) for i in dofs)
        lag = delay = 0.0
        if self._actuator is not None:
            if model.actuator_dyntype[self._actuator] != int(mujoco.mjtDyn.mjDYN_NONE):
                lag = float(model.actuator_dynprm[self._actuator, 0])
            delay = float(model.actuator_delay[self._actuator])
            # MuJoCo stores the motor's separately.
            damping += float(model.actuator_damping[self._actuator]) * self._gear**2
        gain = abs(gain)
        return pendulum_plant(
            inertia=inertia / gain,
            damping=damping / gain,
            gravity=weight / gain,
            coulomb_friction=sum(float(model.dof_frictionloss[i]) for i in dofs) / gain,
            angle_offset=wrap(self._sign * (hanging - self._zero)),
            effort_limit=limit,
            actuator_time_constant=lag,
            transport_delay=delay,
            name=Path(self._path).stem,
        )


def _smaller(bounds: Any) -> float:
    return float(min(abs(bounds[0]), abs(bounds[1])))
