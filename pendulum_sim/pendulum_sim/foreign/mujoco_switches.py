"""Parts of a MuJoCo model that can be switched off, to test whether they cause a deviation from an equation."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

__all__ = ["CAUSES", "switch_off"]

_FINER = 8
_LOCKED = 1e6
"""Inertia that locks a joint, relative to the largest of the model."""
_DISABLED = {"contact": "mjDSBL_CONTACT", "an equality constraint": "mjDSBL_EQUALITY"}
_CLEARED = {
    "the range of a joint": ("jnt_limited",),
    "gravity compensation": ("body_gravcomp",),
    "a tendon": (
        *("tendon_stiffness", "tendon_stiffnesspoly", "tendon_damping", "tendon_dampingpoly"),
        *("tendon_frictionloss", "tendon_limited", "tendon_armature"),
    ),
    "a spring": ("jnt_stiffness", "jnt_stiffnesspoly"),
    "polynomial damping": ("dof_dampingpoly", "actuator_dampingpoly"),
    "damping of the actuator": ("actuator_damping",),
    "delay of the actuator": ("actuator_delay",),
    "armature of the actuator": ("actuator_armature",),
}
_DRIVE = "a spring between motor and joint"
_STIFFER = 100.0
_FLUID, _JOINTS, _ACTUATORS = "the fluid around it", "other joints that move", "other actuators"
_FLAG, _TIMESTEP = "a flag that disables a part of MuJoCo", "a timestep too long for the integrator"
CAUSES = (*_DISABLED, *_CLEARED, _DRIVE, _FLUID, _JOINTS, _ACTUATORS, _FLAG, _TIMESTEP)
"""Names of these parts."""


def switch_off(mujoco: Any, model: Any, cause: str, dofs: Collection[int], own: Collection[int]) -> int:
    """Switch one of ``CAUSES`` off in a model, in place; return how many steps replace one.

    ``dofs`` are the degrees of freedom of the joints and their motors; ``own`` are the indices of their actuators.
    """
    if cause in _DISABLED:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, _DISABLED[cause]))
    for field in _CLEARED.get(cause, ()):
        getattr(model, field)[:] = 0
    if cause == _FLUID:
        model.opt.density = model.opt.viscosity = 0.0
        model.opt.wind[:] = 0.0
    elif cause == _DRIVE and len(dofs) > 1:
        # A motor that moves with the link has a rigid plant's equation.
        model.tendon_stiffness[:] *= _STIFFER
    elif cause == _JOINTS:
        others = [i for i in range(model.nv) if i not in dofs]
        model.dof_armature[others] += _LOCKED * max(1.0, float(np.max(model.dof_M0)))
    elif cause == _ACTUATORS:
        others = [i for i in range(model.nactuator) if i not in own]
        for field in ("gainprm", "biasprm", "damping", "dampingpoly"):
            getattr(model, f"actuator_{field}")[others] = 0.0
    elif cause == _FLAG:
        model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    elif cause == _TIMESTEP:
        model.opt.timestep /= _FINER
        return _FINER
    return 1
