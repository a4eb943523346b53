"""LQG of any number of joints: discrete LQR on the state estimated by a Kalman filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pendulum_lqr.controllers.discrete_lqr import SampledFeedback
from pendulum_lqr.controllers.linear_feedback import gain_text
from pendulum_lqr.controllers.specs import DELAY, OFFSET_NOISE
from pendulum_lqr.linear.observer import Observer
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqg"]

_ONE_JOINT = {"position_noise": "angle_noise", "effort_noise": "torque_noise"}
"""Parameter names for a plant of one joint."""


class Lqg(SampledFeedback):
    """Stationary LQG regulator for the whole linear model: estimates motor, spring, lags and efforts in transit."""

    SUMMARY = "LQR on the state that a Kalman filter estimates, motor, lag, delay and constant torques included"

    def _make_observer(self, p: Mapping[str, Any]) -> Observer | None:
        return super()._make_observer({**p, **{name: p[own] for name, own in _ONE_JOINT.items() if own in p}})

    @classmethod
    def own(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return the assumed noise, and the delay."""
        several = plant is not None and not plant.is_pendulum
        position, speed, effort = ("", "", "") if several else ("rad", "rad/s", "N m")
        names = list(_ONE_JOINT) if several else list(_ONE_JOINT.values())
        where, each = (" [rad or m]", " on every joint") if several else ("", "")
        return (
            ParameterSpec(names[0], 2e-4, position, f"Standard deviation of a measured position{where}.", minimum=0.0,
                          exclusive_minimum=True),
            ParameterSpec("velocity_noise", 0.0, speed, "Standard deviation of a measured velocity; 0 to use positions "
                          "alone.", minimum=0.0),
            ParameterSpec(names[1], 0.1 if several else 1.0, effort, f"Standard deviation of the unknown effort{each}, "
                          "held for a period.", minimum=0.0, exclusive_minimum=True),
            OFFSET_NOISE,
            DELAY,
        )  # fmt: skip

    def describe(self) -> str:
        """Return both gains."""
        assert self.observer is not None
        assert self.observer.gain is not None
        return f"{super().describe()}, L = [{gain_text(self.observer.gain.T)}]"
