"""The mapping file of a MuJoCo model: what the model does not define in the contract's terms.

All entries but the format are optional; with several joints all but format and timestep are in ``joints``, by name,
and those of a sliding joint in m and N::

    format: pendulum_simulation/1
    joint: hinge                            # the only hinge, or pendulum_joint, by default
    actuator: torque                        # the only one on that joint by default; none: torque on the joint itself
    sign: -1                                # of the file's angle in ours
    zero: {value: 3.14159, unit: rad}       # the file's angle that is 0 in ours; by default where the link hangs
    effort_limit: {value: 13.0, unit: N m}  # for a joint without an actuator
    timestep: {value: 0.002, unit: s}       # in place of the file's own
    control_per_torque: {value: 1.0, unit: 1/(N m)}  # control for 1 N m of command; by default 1 N m at the joint
    joints:
      elbow: {joint: hinge_2, sign: -1}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, load_yaml, reject_unknown, require_mapping
from pendulum_msgs_py.plants.quantities import read_quantities

__all__ = ["FORMAT", "NO_ACTUATOR", "JointMapping", "MujocoMapping", "load_mujoco_mapping"]

FORMAT = "pendulum_simulation/1"
NO_ACTUATOR = "none"
_TEXTS = ("joint", "actuator")
_TIMESTEP = ParameterSpec("timestep", 0.002, "s", "Timestep.", minimum=0.0, exclusive_minimum=True)


@dataclass(frozen=True)
class JointMapping:
    """Entries of one joint; None and empty text mean an automatic choice.

    Attributes:
        joint: Name of the hinge or slide.
        actuator: Name of the actuator; ``none`` for an effort on the joint itself.
        sign: Sign of the file's position in the contract's, 1 or -1.
        zero: The file's position that is 0 in the contract [rad or m].
        effort_limit: Largest effort [N m or N].
        control_per_torque: Control for a command of 1 [1/(N m) or 1/N].
    """

    joint: str = ""
    actuator: str = ""
    sign: int = 1
    zero: float | None = None
    effort_limit: float | None = None
    control_per_torque: float | None = None


@dataclass(frozen=True)
class MujocoMapping:
    """Content of a mapping file.

    Attributes:
        one: Entries of the one joint.
        joints: Entries of several, by name.
        timestep: In place of the file's own [s].
    """

    one: JointMapping = JointMapping()
    timestep: float | None = None
    joints: Mapping[str, JointMapping] = field(default_factory=dict)


def load_mujoco_mapping(path: str | Path, joints: Sequence[Joint] = ()) -> MujocoMapping:
    """Return the mapping in a file, for a model of several ``joints`` or one; a ParameterError names file and entry."""
    document = load_yaml(path, "mapping file")
    if document.pop("format", None) != FORMAT:
        raise ParameterError(f"{path}: format is missing or another; expected {FORMAT!r}")
    where, timestep = str(path), {name: document.pop(name) for name in ("timestep",) if name in document}
    step = read_quantities(timestep, (_TIMESTEP,), where)[0].get("timestep")
    if not joints:
        return MujocoMapping(_entries(document, ONE_JOINT.joints[0], where), step)
    reject_unknown(document, ("joints",), where=where)
    entries = require_mapping(document.get("joints", {}), f"{where}: joints")
    reject_unknown(entries, [joint.name for joint in joints], where=f"{where}: joints")
    found = {
        joint.name: _entries(entries[joint.name], joint, f"{where}: {joint.name}")
        for joint in joints
        if joint.name in entries
    }
    return MujocoMapping(joints=found, timestep=step)


def _entries(given: object, joint: Joint, where: str) -> JointMapping:
    unit = joint.effort_unit
    specs = (
        ParameterSpec("zero", 0.0, joint.unit, "The file's position that is 0 in ours."),
        ParameterSpec("effort_limit", 1.0, unit, "Largest effort.", minimum=0.0, exclusive_minimum=True),
        ParameterSpec("control_per_torque", 1.0, f"1/({unit})" if " " in unit else f"1/{unit}", "Control for 1 of it."),
    )
    document, names = require_mapping(given, where), [spec.name for spec in specs]
    reject_unknown(document, (*_TEXTS, "sign", *names), where=where)
    for name in _TEXTS:
        if not isinstance(document.get(name, ""), str):
            raise ParameterError(f"{where}: {name} is {document[name]!r}; expected a name")
    sign = document.get("sign", 1)
    if sign not in {1, -1} or isinstance(sign, bool):
        raise ParameterError(f"{where}: sign is {sign!r}; expected 1 or -1")
    quantities, _ = read_quantities({name: document[name] for name in names if name in document}, specs, where)
    texts = {name: document[name] for name in _TEXTS if name in document}
    return JointMapping(sign=sign, **texts, **quantities)  # type: ignore[arg-type]  # by name
