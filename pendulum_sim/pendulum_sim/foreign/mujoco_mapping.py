"""The mapping file of a MuJoCo model: what the model does not define in the contract's terms.

All entries but the format are optional::

    format: pendulum_simulation/1
    joint: hinge                            # the only hinge, or pendulum_joint, by default
    actuator: torque                        # the only one on that joint by default; none: torque on the joint itself
    sign: -1                                # of the file's angle in ours
    zero: {value: 3.14159, unit: rad}       # the file's angle that is 0 in ours; by default where the link hangs
    effort_limit: {value: 13.0, unit: N m}  # for a joint without an actuator
    timestep: {value: 0.002, unit: s}       # in place of the file's own
    control_per_torque: {value: 1.0, unit: 1/(N m)}  # control for 1 N m of command; by default 1 N m at the joint
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, load_yaml, reject_unknown
from pendulum_msgs_py.plants.quantities import read_quantities

__all__ = ["FORMAT", "NO_ACTUATOR", "MujocoMapping", "load_mujoco_mapping"]

FORMAT = "pendulum_simulation/1"
NO_ACTUATOR = "none"
_QUANTITIES = (
    ParameterSpec("zero", 0.0, "rad", "The file's angle that is 0 in ours."),
    ParameterSpec("effort_limit", 1.0, "N m", "Largest torque.", minimum=0.0, exclusive_minimum=True),
    ParameterSpec("timestep", 0.002, "s", "Timestep.", minimum=0.0, exclusive_minimum=True),
    ParameterSpec("control_per_torque", 1.0, "1/(N m)", "Control for a command of 1 N m."),
)
_TEXTS = ("joint", "actuator")


@dataclass(frozen=True)
class MujocoMapping:
    """Content of a mapping file; None and empty text mean an automatic choice.

    Attributes:
        joint: Name of the hinge.
        actuator: Name of the actuator; ``none`` for torque on the joint itself.
        sign: Sign of the file's angle in the contract's, 1 or -1.
        zero: The file's angle that is 0 in the contract [rad].
        effort_limit: Largest torque [N m].
        timestep: In place of the file's own [s].
        control_per_torque: Control for a command of 1 N m [1/(N m)].
    """

    joint: str = ""
    actuator: str = ""
    sign: int = 1
    zero: float | None = None
    effort_limit: float | None = None
    timestep: float | None = None
    control_per_torque: float | None = None


def load_mujoco_mapping(path: str | Path) -> MujocoMapping:
    """Return the mapping in a file; a ParameterError names file and entry."""
    document = load_yaml(path, "mapping file")
    names = [spec.name for spec in _QUANTITIES]
    reject_unknown(document, ("format", *_TEXTS, "sign", *names), where=str(path))
    if document.get("format") != FORMAT:
        raise ParameterError(f"{path}: format is {document.get('format')!r}; expected {FORMAT!r}")
    for name in _TEXTS:
        if not isinstance(document.get(name, ""), str):
            raise ParameterError(f"{path}: {name} is {document[name]!r}; expected a name")
    sign = document.get("sign", 1)
    if sign not in {1, -1} or isinstance(sign, bool):
        raise ParameterError(f"{path}: sign is {sign!r}; expected 1 or -1")
    quantities, _ = read_quantities(
        {name: document[name] for name in names if name in document}, _QUANTITIES, str(path)
    )
    texts = {name: document[name] for name in _TEXTS if name in document}
    return MujocoMapping(sign=sign, **texts, **quantities)  # type: ignore[arg-type]  # by name
