"""Sliding mode with a boundary layer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["SlidingMode"]


class SlidingMode(BaseController):
    """Drives s = theta_dot + lambda e, with e = theta - theta*, to zero.

      u = G sin(theta - theta_0) - tau_0 - b lambda e - M lambda theta_dot - k sat(s / phi)

    with the plant's offsets theta_0 and tau_0. This leaves M s' = -b s - k sat(s / phi) + d. The plant's damping is not
    cancelled, because that is unstable in a sampled loop with a period above 2 M / b (9 ms for the thesis's plant).
    Switching is smooth inside the layer, to avoid chattering; so a constant torque d below b phi + k is not rejected
    but leaves e = d / (lambda (b + k / phi)), which may be more than a plain LQR leaves. Source: Slotine and Li,
    Applied Nonlinear Control, 1991, section 7.2.
    """

    SAMPLED = False
    BALANCES = True
    SUMMARY = "sliding mode with a boundary layer: gives way by d / (lambda (b + k / phi)) to a constant torque d"
    PARAMETERS = (
        ParameterSpec("rate", 5.0, "1/s", "Slope of the sliding line, lambda.", minimum=0.0, exclusive_minimum=True),
        ParameterSpec("gain", 1.0, "N m", "Switching torque, k.", minimum=0.0),
        ParameterSpec(
            "layer",
            0.5,
            "rad/s",
            "Half width of the boundary layer, phi.",
            minimum=0.0,
            exclusive_minimum=True,
        ),
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(p["effort_limit"], p["set_point"])
        self.rate, self.gain, self.layer = p["rate"], p["gain"], p["layer"]
        self._plant = plant
        self._proportional = plant.damping * self.rate
        self._derivative = plant.inertia * self.rate

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        error = self.error(x[0])
        sliding = (x[1] + self.rate * error) / self.layer
        switch = 1.0 if sliding > 1.0 else (max(sliding, -1.0))
        return self.clamp(
            -self._plant.gravity * math.sin(x[0] - self._plant.angle_offset)
            - self._plant.torque_offset
            - self._proportional * error
            - self._derivative * x[1]
            - self.gain * switch
        )

    def describe(self) -> str:
        """Return slope, gain and layer."""
        return f"lambda = {self.rate:g} 1/s, k = {self.gain:g} N m, phi = {self.layer:g} rad/s"
