"""PD with gravity compensation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller import BaseController
from pendulum_lqr.model import linearise, low_frequency, torque_gain
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["PdGravity"]


class PdGravity(BaseController):
    """u = (G_c sin(theta - angle_offset) - torque_offset) / gain - k_p (theta - theta*) - k_d theta_dot.

    Holds any angle, upright or not; gain is what the actuator gives per torque asked for, 1 for a rigid plant.

    Args:
        plant: Plant parameters.
        kp: Proportional gain [N m/rad].
        kd: Derivative gain [N m s/rad].
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
    """

    SUMMARY = "PD with gravity compensation: holds any angle"
    PARAMETERS = (
        ParameterSpec(
            "bandwidth",
            5.0,
            "rad/s",
            "Slowest pole asked for; sets the gains that are 0.",
            minimum=0.0,
            exclusive_minimum=True,
        ),
        ParameterSpec("kp", 0.0, "N m/rad", "Proportional gain; 0 for that of the bandwidth.", minimum=0.0),
        ParameterSpec("kd", 0.0, "N m s/rad", "Derivative gain; 0 for that of the bandwidth.", minimum=0.0),
    )

    def __init__(
        self, plant: PlantParameters, kp: float, kd: float, effort_limit: float, set_point: float = 0.0
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.kp = kp
        self.kd = kd
        gain = torque_gain(plant)
        self._gravity = plant.gravity / gain
        self._angle_offset = plant.angle_offset
        self._offset = plant.torque_offset / gain

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> PdGravity:
        """Place the slowest pole of M s^2 + (b + k_d) s + k_p at -bandwidth, critically damped if b allows.

        M and b are those of slow motion, motor and gears included.
        """
        w = p["bandwidth"]
        inertia, damping, _ = low_frequency(linearise(plant.with_values(gravity=0.0)))
        kd = p["kd"] if p["kd"] > 0.0 else max(0.0, 2.0 * inertia * w - damping)
        # M w^2 - (b + k_d) w + k_p = 0; where damping is ample the other pole is faster.
        kp = p["kp"] if p["kp"] > 0.0 else w * (damping + kd) - inertia * w * w
        return cls(plant, kp, kd, p["effort_limit"], p["set_point"])

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        # sin(theta) = -sin(theta - pi)
        weight = -self._gravity * math.sin(x[0] - self._angle_offset) - self._offset
        return self.clamp(weight - self.kp * self.error(x[0]) - self.kd * x[1])

    def describe(self) -> str:
        """Return the gains."""
        return f"kp = {self.kp:.6g} N m/rad, kd = {self.kd:.6g} N m s/rad"
