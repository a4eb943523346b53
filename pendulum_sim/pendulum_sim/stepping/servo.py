"""Position control of the simulated joint, critically damped.

    u = G sin(theta) + b theta_ref' + k (theta_ref - theta) + (c - b) (theta_ref' - theta')

places the poles of M e'' + c e' + k e = 0 with c = max(b, 2 M w), k = c w - M w^2: the slow one is -w.
"""

from __future__ import annotations

import math

from pendulum_msgs_py.dynamics import gravity_torque
from pendulum_msgs_py.dynamics.series_elastic import shorted_winding_damping
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["PositionServo"]


class PositionServo:
    """Model-based position controller with period dt [s], clamped to the plant's effort limit."""

    def __init__(self, parameters: PlantParameters, dt: float) -> None:
        # A quarter of a radian of phase per period leaves a margin for the held command and the plant's delays.
        lateness = dt + parameters.transport_delay + parameters.actuator_time_constant
        omega = min(60.0, 0.25 / lateness)
        inertia, damping, gain = parameters.inertia, parameters.damping, 1.0
        drive = parameters.drivetrain
        if drive is not None:
            # Stay well below the resonance of link and spring.
            omega = min(omega, 0.25 * math.sqrt(drive.stiffness / parameters.inertia))
            inertia += drive.reflected_inertia
            damping += drive.motor_damping + shorted_winding_damping(
                drive.torque_constant, drive.back_emf_constant, drive.gear_ratio, drive.winding_resistance
            )
            # In feed-forward a command of 1 N m gives 1/eta at the motor.
            gain = drive.efficiency
        total = max(damping, 2.0 * inertia * omega)
        self._stiffness = gain * (total * omega - inertia * omega * omega)
        self._damping = gain * (total - damping)
        self._feedforward = gain * damping
        self._gain = gain
        self._parameters = parameters

    def effort(
        self, theta: float, theta_dot: float, position: float, velocity: float, *, limit: float = math.inf
    ) -> float:
        """Return the torque [N m] towards a wanted position [rad] and velocity [rad/s], within the lower limit."""
        parameters = self._parameters
        weight = gravity_torque(theta - parameters.angle_offset, parameters.gravity)
        wanted = (
            self._gain * (weight - parameters.torque_offset)
            + self._feedforward * velocity
            + self._stiffness * (position - theta)
            + self._damping * (velocity - theta_dot)
        )
        limit = min(limit, parameters.effort_limit)
        return min(limit, max(-limit, wanted))
