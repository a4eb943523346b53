"""The newest values to draw of each joint of a plant."""

from __future__ import annotations

from math import dist, isfinite
from typing import Any

from pendulum_msgs_py.contract.cdr import JointStateFields
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms import MECHANISMS

__all__ = ["JointValues"]

_FRESH = 0.3
"""Age at which a torque counts as ended [s]; plants accept none older than 0.05 s."""
_KNOWN = {tuple(joint.name for joint in mechanism.joints): mechanism for mechanism in MECHANISMS.values()}


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
            # JSON has no infinities or NaN.
            values = {key: value for key, value in {**self._states[joint.name], **efforts}.items() if isfinite(value)}
            joints.append({"name": joint.name, "unit": joint.unit, "goal": joint.goal, **values})
        return {"joints": joints, **self._drawn()}

    def _drawn(self) -> dict[str, Any]:
        """Return the chain to draw, to the right and up, of a mechanism with its default sizes and a reach of 1."""
        mechanism = _KNOWN.get(tuple(joint.name for joint in self._joints))
        position = tuple(self._states[joint.name]["theta"] for joint in self._joints)
        if mechanism is None or not all(map(isfinite, position)):
            return {}
        p = (*(spec.default for spec in mechanism.parameters), *(0.0 for _ in mechanism.joints))
        still = mechanism.chain((0.0,) * len(position), p)
        scale = 1.0 / sum(map(dist, still, still[1:]))
        drawn = [[scale * value for value in mechanism.seen(point)] for point in mechanism.chain(position, p)]
        circle = [scale * value for value in mechanism.seen((dist(*still[:2]),) * 2 + (0.0,))]
        return {
            "points": drawn,
            "slides": self._joints[0].unit == "m",
            **({"circle": circle} if mechanism.in_space else {}),
        }


def _joints(names: tuple[str, ...]) -> tuple[Joint, ...]:
    return _KNOWN[names].joints if names in _KNOWN else tuple(Joint(name) for name in names)
