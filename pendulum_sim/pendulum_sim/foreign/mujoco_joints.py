"""The joints of a MuJoCo model that a plant has: which they are, where they hang, and their zeros."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.foreign.mujoco_joint import ROUNDING, MujocoJoint
from pendulum_sim.foreign.mujoco_mapping import JointMapping, MujocoMapping

__all__ = ["Hang", "find_joints", "place"]

_UNITS = {"HINGE": "rad", "SLIDE": "m"}
_SWEEPS = 100
"""Largest number of times that each joint is brought to where it hangs beneath the others."""

Hang = tuple[float, float]
"""Weight and hanging position of a joint, in the file's terms."""


def find_joints(
    mujoco: Any,
    model: Any,
    data: Any,
    path: str,
    mapping: MujocoMapping,
    coordinates: Coordinates,
    limits: Sequence[float],
    name: str,
) -> tuple[tuple[MujocoJoint, ...], list[Hang]]:
    """Return the joints of a model that are those of a plant called ``name``, zeros set, and where they hang.

    ``limits`` are the largest efforts of the driven joints that the file lacks, 0 for none [N m or N].

    Raises:
        ParameterError: The model has no such joints, or they cannot be driven.
    """
    chosen = (
        _chosen(mapping, path)
        if coordinates == ONE_JOINT
        else _matched(mujoco, model, mapping, coordinates, path, name)
    )
    of_driven = dict(zip(coordinates.driven, limits, strict=True))
    joints = tuple(
        MujocoJoint(
            mujoco, model, data, path, joint, chosen[joint.name], driven=i in of_driven,
            effort_limit=of_driven.get(i, 0.0),
        )
        for i, joint in enumerate(coordinates.joints)
    )  # fmt: skip
    hangs = _hang(mujoco, model, data, joints)
    for joint, (_, hanging) in zip(joints, hangs, strict=True):
        zero = chosen[joint.joint.name].zero
        rests = 0.0 if joint.is_own else joint.rest(partial(place, mujoco, model, data, joints, hangs, joint), hanging)
        joint.zero = rests if zero is None else zero
    return joints, hangs


def place(
    mujoco: Any,
    model: Any,
    data: Any,
    joints: Sequence[MujocoJoint],
    hangs: Sequence[Hang],
    moved: MujocoJoint,
    position: float,
) -> None:
    """Put one joint at rest at a position of the file's, and the others where they hang."""
    mujoco.mj_resetData(model, data)
    for joint, (_, hanging) in zip(joints, hangs, strict=True):
        joint.put(position if joint is moved else hanging)
    mujoco.mj_forward(model, data)


def _chosen(mapping: MujocoMapping, path: str) -> Mapping[str, JointMapping]:
    """Return the entries for the one joint of a pendulum."""
    if mapping.joints:
        listed = ", ".join(mapping.joints)
        raise ParameterError(
            f"the mapping of {path} has joints ({listed}); expected a plant file of several joints with them"
        )
    return {ONE_JOINT.joints[0].name: mapping.one}


def _matched(
    mujoco: Any, model: Any, mapping: MujocoMapping, coordinates: Coordinates, path: str, plant: str
) -> Mapping[str, JointMapping]:
    """Return the entries of each joint; without any, joints of the file count by name, or else in order."""
    joints = coordinates.joints
    found = {joint.name: mapping.joints.get(joint.name, JointMapping()) for joint in joints}
    kinds = {int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")): unit for kind, unit in _UNITS.items()}
    there = [
        (str(model.joint(i).name), kinds[int(model.jnt_type[i])])
        for i in range(model.njnt)
        if int(model.jnt_type[i]) in kinds
    ]
    if all(each.joint or name in dict(there) for name, each in found.items()):
        return found
    if [unit for _, unit in there] == [joint.unit for joint in joints] and all(name for name, _ in there):
        for joint, (name, _) in zip(joints, there, strict=True):
            found[joint.name] = replace(found[joint.name], joint=found[joint.name].joint or name)
        return found
    has = ", ".join(f"{name or 'one without a name'} [{unit}]" for name, unit in there) or "none"
    raise ParameterError(
        f"{path} has the joints {has}; expected those of {plant}, {coordinates.with_units}, "
        "by these names or in this order, or joints in a mapping file"
    )


def _hang(mujoco: Any, model: Any, data: Any, joints: Sequence[MujocoJoint]) -> list[Hang]:
    """Return weight and hanging position of each joint, with all of them hanging."""
    found = [(0.0, float(model.qpos0[joint.qpos])) for joint in joints]
    for _ in range(_SWEEPS):
        before = list(found)
        for i, joint in enumerate(joints):
            weight, hanging = joint.weight(partial(place, mujoco, model, data, joints, found, joint))
            # Removes the fit's rounding, and -pi.
            hanging = 0.0 if abs(hanging) < ROUNDING else hanging
            found[i] = weight, math.pi if abs(abs(hanging) - math.pi) < ROUNDING else hanging
        if len(found) == 1 or max(abs(a[1] - b[1]) for a, b in zip(found, before, strict=True)) < ROUNDING:
            break
    return found
