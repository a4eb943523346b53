"""The newest values to draw of each joint of a plant."""

from __future__ import annotations

from math import isfinite
from typing import Any

from pendulum_msgs_py.contract.cdr import JointStateFields
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms import MECHANISMS

__all__ = ["JointValues"]

_FRESH = 0.3
"""Age at which a torque counts as ended [s]; plants accept none older than 0.05 s."""
_CHAIN = MECHANISMS["double_pendulum"]
_CART = MECHANISMS["cart_pole"]
_ROTARY = MECHANISMS["furuta"]


class JointValues:
    """The latest positions, velocities and efforts of a plant's joints, by name."""

    def __init__(self) -> None:
        self.stamp_ns = 0
        self._joints: tuple[Joint, ...] = ()
        self._states: dict[str, dict[str, float]] = {}
        self._efforts: dict[tuple[str, str], tuple[float, float]] = {}

    def take_state(self, fields: JointStateFields) -> None:
        """Store a state; one without position and velocity for each joint is ignored."""
        if not fields.joints or not len(fields.joints) == len(fields.position) == len(fields.velocity):
            return
        if fields.joints != tuple(joint.name for joint in self._joints):
            self._joints, self._states = _joints(fields.joints), {}
        self.stamp_ns = fields.stamp_ns
        efforts = fields.effort or (0.0,) * len(fields.joints)
        for name, theta, theta_dot, measured in zip(
            fields.joints, fields.position, fields.velocity, efforts, strict=True
        ):
            self._states[name] = {"theta": theta, "theta_dot": theta_dot, "measured": measured}

    def take_effort(self, kind: str, fields: JointStateFields, now: float) -> None:
        """Store efforts that arrived at ``now`` [s] as ``command``, ``disturbance`` or ``applied``."""
        # One effort without a name is for the only joint.
        names = fields.joints or tuple(joint.name for joint in self._joints)
        for name, effort in zip(names, fields.effort, strict=False):
            self._efforts[name, kind] = (effort, now)

    def picture(self, now: float) -> dict[str, Any]:
        """Return each joint with unit, upright position and values at time ``now`` [s], without old torques."""
        self._efforts = {key: known for key, known in self._efforts.items() if now - known[1] <= _FRESH}
        joints = []
        for joint in self._joints:
            efforts = {kind: effort for (name, kind), (effort, _) in self._efforts.items() if name == joint.name}
            # JSON has no infinities or NaN: the page could read nothing more, of any plant.
            values = {key: value for key, value in {**self._states[joint.name], **efforts}.items() if isfinite(value)}
            joints.append({"name": joint.name, "unit": joint.unit, "goal": joint.goal, **values})
        # Drawn as a whole: links hanging on each other, a pole on a cart, a pendulum at the end of an arm.
        whole = {"chain": _CHAIN, "cart": _CART, "rotary": _ROTARY}
        return {"joints": joints, **{name: self._joints == plant.joints for name, plant in whole.items()}}


def _joints(names: tuple[str, ...]) -> tuple[Joint, ...]:
    """Return the joints of the mechanism with these names, or hinges from 0 if none is known."""
    known = {tuple(joint.name for joint in one.joints): one.joints for one in MECHANISMS.values()}
    return known.get(names) or tuple(Joint(name) for name in names)
