"""What the joints of a plant have, as the steps of :mod:`pendulum_msgs_py.dynamics.joint_steps` take it."""

from __future__ import annotations

from pendulum_msgs_py.dynamics.joint_steps import FAR, JointTable
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["pack_joints"]


def pack_joints(parameters: MechanismParameters) -> JointTable:
    """Return friction, stops and lags of a plant's joints, in the order of ``JOINT_ROWS``."""
    joints = parameters.joints
    return (
        tuple(joint.coulomb_friction for joint in joints),
        tuple(joint.breakaway for joint in joints),
        tuple(joint.stribeck_velocity for joint in joints),
        tuple(-FAR if joint.lower_stop is None else joint.lower_stop for joint in joints),
        tuple(FAR if joint.upper_stop is None else joint.upper_stop for joint in joints),
        tuple(0.0 if joint.actuator is None else joint.actuator.time_constant for joint in joints),
    )
