"""Parameters that several controllers share."""

from __future__ import annotations

from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["CATCH_Q", "CATCH_R", "CATCH_SHARE", "DELAY", "FEEDFORWARD", "OFFSET_NOISE", "Q", "R"]

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
DELAY = ParameterSpec(
    "delay", 0.0, "s", "Delay from state to torque, beyond the plant's own transport_delay.", minimum=0.0, maximum=1.0
)
OFFSET_NOISE = ParameterSpec(
    "offset_noise",
    0.0,
    "N m/s^0.5",
    "How fast an unknown constant torque may wander; > 0 observes and cancels it, so that no offset stays.",
    minimum=0.0,
)
CATCH_Q = ParameterSpec("catch_q", [100.0, 1.0], "1/rad^2, s^2/rad^2", "Weights of the LQR that catches.", minimum=0.0)
CATCH_R = ParameterSpec("catch_r", 0.1, "1/(N m)^2", "Its weight of torque.", minimum=0.0, exclusive_minimum=True)
CATCH_SHARE = ParameterSpec(
    "catch_share",
    1.0,
    "-",
    "Share of the proven region of attraction in which it takes over.",
    minimum=0.0,
    maximum=1.0,
    exclusive_minimum=True,
)
