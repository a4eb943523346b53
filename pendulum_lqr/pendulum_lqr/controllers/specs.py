"""Parameters that several controllers share."""

from __future__ import annotations

from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["FEEDFORWARD", "Q", "R"]

Q = ParameterSpec(
    "q", [100.0, 0.01], "1/rad^2, s^2/rad^2", "Weights of angle and velocity: the diagonal of Q.", minimum=0.0
)
R = ParameterSpec("r", 0.1, "1/(N m)^2", "Weight of torque, R.", minimum=0.0, exclusive_minimum=True)
FEEDFORWARD = ParameterSpec(
    "feedforward",
    True,
    "",
    "Whether the torque that holds the set-point against gravity is added, G_c sin(theta*).",
)
