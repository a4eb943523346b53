"""One joint of a MuJoCo model in the contract's terms: zero, sign, actuator, limit and weight."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.foreign.mujoco_mapping import NO_ACTUATOR, JointMapping

__all__ = ["ROUNDING", "MujocoJoint"]

CONTRACT_ACTUATOR = "effort"
ROUNDING = 1e-12
_ANGLES = 24
_REST_ANGLES = 721
_BISECTIONS = 60
_KINDS = {"rad": "hinge", "m": "slide"}


class MujocoJoint:
    """A hinge or slide of a model, with the actuator that drives it or none.

    Args:
        mujoco: The module.
        model: The model; ``data`` is its state.
        path: Its file, for messages.
        joint: Joint of the contract.
        mapping: Entries of a mapping file; a missing ``joint`` is that of this name, or the model's only one.
        driven: Whether a command drives it; a passive joint needs no actuator and no limit.
        effort_limit: Largest effort if neither file nor mapping has one, 0 for none [N m or N].
    """

    def __init__(
        self,
        mujoco: Any,
        model: Any,
        data: Any,
        path: str,
        joint: Joint,
        mapping: JointMapping,
        *,
        driven: bool = True,
        effort_limit: float = 0.0,
    ) -> None:
        self._mujoco, self._model, self._data, self._path = mujoco, model, data, path
        self.joint, self.unit = joint, joint.effort_unit
        self._id = self._choose_joint(mapping.joint)
        self.qpos, self.dof = int(model.jnt_qposadr[self._id]), int(model.jnt_dofadr[self._id])
        self.name = self._name("joint", self._id)
        self.is_own = self.name == joint.name
        self.sign = mapping.sign
        self.actuator = self._choose_actuator(mapping.actuator, self._id) if driven else None
        if self.actuator is not None:
            # An actuator may have several controls.
            self.control = int(model.actuator_ctrladr[self.actuator])
            self.gear = float(model.actuator_gear[model.actuator_outadr[self.actuator], 0])
        self.driven_dof = self.dof if self.actuator is None else self._driven_dof(self.actuator)
        self._driven_qpos = self.qpos if self.driven_dof == self.dof else self._qpos_of(self.driven_dof)
        per_control = 1.0 if self.actuator is None else self._torque_per_control(self.actuator)
        of_contract = self.actuator is not None and self._name("actuator", self.actuator) in (
            {CONTRACT_ACTUATOR} if joint.name == JOINT else {joint.name}
        )
        own = self.is_own and of_contract
        self.control_per_torque = mapping.control_per_torque or (1.0 if own else 1.0 / per_control)
        self.gain = per_control * self.control_per_torque
        self.zero, self.push = 0.0, 0.0
        self.limit = self._limit(mapping.effort_limit, effort_limit, self._id) if driven else math.inf
        self.motor = "the joint itself"
        if self.actuator is not None:
            self.motor = f"actuator {self._name('actuator', self.actuator)!r}"

    @property
    def position(self) -> float:
        """Present position in the contract [rad or m]."""
        return self.sign * (float(self._data.qpos[self.qpos]) - self.zero)

    @property
    def velocity(self) -> float:
        """Present velocity in the contract [rad/s or m/s]."""
        return self.sign * float(self._data.qvel[self.dof])

    @property
    def effort(self) -> float:
        """Effort of the actuator at the joint [N m or N]."""
        data = self._data
        if self.driven_dof != self.dof:
            # Behind a motor's spring a sensor at the joint measures the spring.
            effort = float(data.qfrc_spring[self.dof])
        elif self.actuator is None:
            effort = float(data.qfrc_applied[self.dof]) - self.sign * self.push
        else:
            effort = float(data.qfrc_actuator[self.dof])
        return self.sign * effort

    def use(self, model: Any, data: Any) -> None:
        """Take another model of the same file, and its state."""
        self._model, self._data = model, data

    def start(self, position: float, velocity: float) -> None:
        """Write a start in the contract's terms into the state; a motor follows."""
        self.put(self.zero + self.sign * position)
        self._data.qvel[self.dof] = self._data.qvel[self.driven_dof] = self.sign * velocity
        self.push = 0.0

    def drive(self, command: float, push: float) -> None:
        """Write a command within the limit, and a push on the joint itself [N m or N]."""
        self.push = applied = push
        if self.actuator is None:
            applied += command
        else:
            self._data.ctrl[self.control] = self.sign * command * self.control_per_torque
        self._data.qfrc_applied[self.dof] = self.sign * applied

    def put(self, position: float) -> None:
        """Put the joint, with a motor, at a position of the file's."""
        model, data = self._model, self._data
        data.qpos[self.qpos] = position
        if self.driven_dof != self.dof:
            data.qpos[self._driven_qpos] = model.qpos0[self._driven_qpos] + position - model.qpos0[self.qpos]

    def _name(self, kind: str, index: int) -> str:
        return str(getattr(self._model, kind)(index).name) or f"number {index}"

    def _choose_joint(self, wanted: str) -> int:
        kind = _KINDS[self.joint.unit]
        number = int(getattr(self._mujoco.mjtJoint, f"mjJNT_{kind.upper()}"))
        ids = [i for i in range(self._model.njnt) if self._model.jnt_type[i] == number]
        names = {self._name("joint", i): i for i in ids}
        listed = ", ".join(names) or "none"
        if wanted:
            if wanted not in names:
                raise ParameterError(f"{self._path} has no {kind} {wanted!r}; expected one of its {kind}s: {listed}")
            return names[wanted]
        if self.joint.name in names:
            return names[self.joint.name]
        if len(ids) != 1:
            raise ParameterError(
                f"{self._path} has {len(ids)} {kind}s ({listed}); expected one, or joint in a mapping file"
            )
        return ids[0]

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
        if not on_joint and self.joint.name == JOINT and self.is_own and CONTRACT_ACTUATOR in names:
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
        kind = int(self._model.jnt_type[self._id])
        if self._model.actuator_trntype[actuator] not in kinds or self._model.jnt_type[joint] != kind:
            raise ParameterError(
                f"actuator {self._name('actuator', actuator)!r} of {self._path} drives no {_KINDS[self.joint.unit]}; "
                "expected one that does, or actuator: none in a mapping file"
            )
        return int(self._model.jnt_dofadr[joint])

    def _qpos_of(self, dof: int) -> int:
        return int(self._model.jnt_qposadr[self._model.dof_jntid[dof]])

    def _torque_per_control(self, actuator: int) -> float:
        model, mujoco = self._model, self._mujoco
        torque = self.gear * float(model.actuator_gainprm[actuator, 0])
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
        model, actuator = self._model, self.actuator
        limits = []
        if actuator is not None:
            per_command = abs(self.control_per_torque)
            per_force = abs(self._torque_per_control(actuator) * self.control_per_torque / self.gear)
            for limited, bounds, per in (
                (model.actuator_ctrllimited[self.control], model.actuator_ctrlrange[self.control], per_command),
                (model.actuator_actlimited[actuator], model.actuator_actrange[actuator], per_command),
                (model.actuator_forcelimited[actuator], model.actuator_forcerange[actuator], per_force),
            ):
                if limited and not bounds[0] < 0.0 < bounds[1]:
                    low, high = sorted(float(bound) / per for bound in bounds)
                    raise ParameterError(
                        f"actuator {self._name('actuator', actuator)!r} of {self._path} gives {low:g} to {high:g} "
                        f"{self.unit}; "
                        "expected torque both ways, or actuator: none and effort_limit in a mapping file"
                    )
                if limited:
                    limits.append(_smaller(bounds) / per)
        if self.driven_dof == self.dof and model.jnt_actfrclimited[joint] and (actuator is not None or not of_mapping):
            limits.append(_smaller(model.jnt_actfrcrange[joint]))
        known = min(limits, default=math.inf)
        if of_mapping is not None and of_mapping > known:
            raise ParameterError(
                f"effort_limit is {of_mapping:g} {self.unit}, the actuator of {self._path} gives {known:g} "
                f"{self.unit}; expected at most that, or actuator: none for torque on the joint itself"
            )
        limit = min(known, of_mapping or of_user or known)
        if not (math.isfinite(limit) and limit > 0.0):
            raise ParameterError(
                f"{self._path} has no limit of torque at its joint {self.name!r}; expected effort_limit as a "
                "parameter or in a mapping file"
            )
        return limit

    def weight(self, place: Callable[[float], None]) -> tuple[float, float]:
        """Return G and q_0 of a weight G sin(q - q_0), in the file's angle and torque.

        ``place`` puts the joint at a position of the file's, with all others at rest where they are.
        """
        if self.joint.unit == "m":
            return 0.0, float(self._model.qpos0[self.qpos])
        data = self._data
        angles = np.linspace(-math.pi, math.pi, _ANGLES, endpoint=False)
        torques = np.empty(_ANGLES)
        for i, angle in enumerate(angles):
            place(angle)
            torques[i] = data.qfrc_bias[self.dof] - data.qfrc_gravcomp[self.dof]
        basis = np.stack([np.sin(angles), np.cos(angles)], axis=1)
        (a, b), *_ = np.linalg.lstsq(basis, torques, rcond=None)
        if float(np.max(np.abs(torques))) < 1e-9:
            return 0.0, float(self._model.qpos0[self.qpos])
        return float(math.hypot(a, b)), math.atan2(-b, a)

    def rest(self, place: Callable[[float], None], hanging: float) -> float:
        """Return where the joint rests: hanging, unless a spring pulls it elsewhere; ``place`` as in ``weight``."""

        def torque(angle: float) -> float:
            place(angle)
            return float(data.qfrc_spring[self.dof] - data.qfrc_bias[self.dof] + data.qfrc_gravcomp[self.dof])

        data = self._data
        place(hanging)
        if not np.any(self._model.jnt_stiffness[[self._model.dof_jntid[self.dof]]]):
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
        return 0.0 if abs(rest) < ROUNDING else rest


def _smaller(bounds: Any) -> float:
    return float(min(abs(bounds[0]), abs(bounds[1])))
