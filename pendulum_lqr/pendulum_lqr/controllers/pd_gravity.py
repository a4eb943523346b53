"""PD with gravity compensation."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.linear.model import linearise, low_frequency
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.equilibrium import torque_gain
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["PdGravity", "pd_gravity_law"]

_KP, _KD, _GRAVITY, _ANGLE_OFFSET, _OFFSET = range(OWN, OWN + 5)


def pd_gravity_law(
    _t: float, angle: float, velocity: float, _memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return gravity torque plus PD torque within the limit [N m], as a :data:`.law.Law`."""
    # sin(theta) = -sin(theta - pi)
    weight = -numbers[_GRAVITY] * math.sin(angle - numbers[_ANGLE_OFFSET]) - numbers[_OFFSET]
    error = deviation(angle, numbers[SET_POINT])
    return clamped(weight - numbers[_KP] * error - numbers[_KD] * velocity, numbers[EFFORT_LIMIT])


class PdGravity(LawController):
    """u = (G_c sin(theta - angle_offset) - torque_offset) / gain - k_p (theta - theta*) - k_d theta_dot.

    Holds any angle, upright or not; gain is the actuator's torque per commanded torque, 1 for a rigid plant.
    """

    SAMPLED = False
    BALANCES = True
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

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        # The slowest pole of M s^2 + (b + k_d) s + k_p is placed at -bandwidth, critically damped if b allows; M and b
        # are those of slow motion, including motor and gears.
        w = p["bandwidth"]
        inertia, damping, _ = low_frequency(linearise(plant.with_values(gravity=0.0)))
        self.kd = p["kd"] if p["kd"] > 0.0 else max(0.0, 2.0 * inertia * w - damping)
        # M w^2 - (b + k_d) w + k_p = 0; with ample damping the other pole is faster.
        self.kp = p["kp"] if p["kp"] > 0.0 else w * (damping + self.kd) - inertia * w * w
        gain = torque_gain(plant)
        numbers = (self.kp, self.kd, plant.gravity / gain, plant.angle_offset, plant.torque_offset / gain)
        super().__init__(pd_gravity_law, p["effort_limit"], p["set_point"], numbers)

    def describe(self) -> str:
        """Return the gains."""
        return f"kp = {self.kp:.6g} N m/rad, kd = {self.kd:.6g} N m s/rad"
