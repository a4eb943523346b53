"""Swing-up by energy, caught by LQR with hysteresis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pendulum_lqr.controller_interface.catch import CatchingController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.specs import CATCH_Q, CATCH_R, CATCH_SHARE
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.swing_up.energy_margin import EnergyMargin
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["EnergySwingUp"]

_REST = 0.02
"""Velocity below which dry friction may hold the pendulum [rad/s]."""


class EnergySwingUp(CatchingController):
    """Pumps energy until the set-point is within reach, then hands over to an LQR.

    Pumping torque: u = clamp(k (E* (1 + margin) - E) theta_dot + b theta_dot + tau_C sgn(theta_dot) - tau_0), with E =
    M theta_dot^2 / 2 + G (1 - cos(theta - theta_0)) and E* that of rest at the set-point; theta_0 and tau_0 are the
    plant's offsets. Its first part is passive; the others compensate friction. At rest, where the velocity gives no
    direction and static friction is larger, it pushes at the limit in the direction of gravity.

    Raises:
        DesignError: Static friction exceeds the torque limit.

    Source: Astrom and Furuta, Swinging up a pendulum by energy control, Automatica 36(2), 2000, eq. 7.
    """

    SAMPLED = False
    SUMMARY = "swing-up by energy shaping, caught by LQR with hysteresis"
    PARAMETERS = (
        ParameterSpec(
            "gain", 50.0, "s/rad", "Pumping torque per energy error and velocity.", minimum=0.0, exclusive_minimum=True
        ),
        ParameterSpec(
            "energy_margin", 0.1, "-", "Energy aimed at beyond that of upright, relative.", minimum=-0.5, maximum=1.0
        ),
        replace(CATCH_Q, default=[30.0, 0.3]),
        replace(CATCH_R, default=1.0),
        CATCH_SHARE,
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        if self.effort_limit <= plant.static_friction + abs(plant.torque_offset):
            raise DesignError(
                f"effort_limit is {self.effort_limit:g} N m; expected more than static friction and torque offset, "
                f"{plant.static_friction + abs(plant.torque_offset):g} N m, or the pendulum may never move"
            )
        self.gain = p["gain"]
        self._plant = plant
        self._target = plant.gravity * (1.0 + math.cos(self.set_point - plant.angle_offset))
        self._margin = EnergyMargin(p["energy_margin"])
        self.reset()

    def reset(self) -> None:
        """Start in the swing-up phase."""
        super().reset()
        self._margin.reset()

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        if self.catch.holds(x[0], x[1]):
            return self.catch.command(x[0], x[1])
        self._margin.learn(wrap(x[0] - self.set_point), x[1])
        return self.clamp(self.pump(x[0], x[1]))

    def pump(self, angle: float, velocity: float) -> float:
        """Return the torque that brings the energy to its target, before the limit [N m]."""
        plant = self._plant
        angle -= plant.angle_offset
        if abs(velocity) < _REST:
            # At the bottom, without a pull of gravity, either side is suitable.
            pull = plant.gravity * math.sin(angle) + plant.torque_offset
            return math.copysign(self.effort_limit, pull)
        energy = 0.5 * plant.inertia * velocity * velocity + plant.gravity * (1.0 + math.cos(angle))
        friction = plant.damping * velocity + math.copysign(plant.coulomb_friction, velocity) - plant.torque_offset
        return self.gain * (self._target * (1.0 + self._margin.value) - energy) * velocity + friction

    def take_over(self, previous: Controller) -> None:
        """Take over the margin, and whether the LQR is in charge."""
        super().take_over(previous)
        if isinstance(previous, EnergySwingUp):
            self._margin.take_over(previous._margin)

    def describe(self) -> str:
        """Return gains of both phases."""
        return f"k = {self.gain:g} s/rad, catch {self.catch.describe()}"
