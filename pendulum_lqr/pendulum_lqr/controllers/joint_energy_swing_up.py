"""Swing-up of plants of several joints by energy, caught by LQR with hysteresis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.linear_feedback import JOINT_LIMIT, joint_limits, require_catching
from pendulum_lqr.controllers.specs import CATCH_Q, CATCH_R, CATCH_SHARE
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of, make_mechanism_catch
from pendulum_lqr.swing_up.energy_margin import EnergyMargin
from pendulum_lqr.swing_up.pump import EnergyPump, pump_gains
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["JointEnergySwingUp"]

_REST = 0.1
"""Velocity below which the margin does not adapt [rad/s]."""


class JointEnergySwingUp(Controller):
    """Pumps energy into a pendulum by moving its hinge until the LQR can catch it.

    The law is that of :mod:`pendulum_lqr.swing_up.pump`. It plans nothing, and a command takes microseconds:
    it starts from any state, also after a push. ``margin`` is the target energy beyond upright, as a share of it [-].
    """

    SUMMARY = "swing-up by energy from anywhere, then LQR; for a pendulum whose hinge is driven"
    SAMPLED = False

    DESIGNING = "tries out from where the LQR catches, which takes some seconds"

    def __init__(self, plant: PlantParameters, pump: EnergyPump, margin: float, catch: MechanismCatch) -> None:
        super().__init__((pump.limit,))
        self.pump, self.catch = pump, catch
        self.margin = EnergyMargin(margin, _REST)
        self._coordinates = plant.coordinates

    @classmethod
    def parameters(cls, plant: PlantParameters) -> tuple[ParameterSpec, ...]:
        """Return gains, with the mechanism's defaults, and LQR parameters; DesignError if not supported."""
        gains = pump_gains(plant)
        joint = _driven(plant)
        q, r = plant.weights
        return (
            ParameterSpec("gain", gains.gain, "-", "Pumping per energy error and velocity, without units.", minimum=0.0,
                          exclusive_minimum=True),
            ParameterSpec("energy_margin", gains.margin, "-", "Energy aimed at beyond that of upright, relative.",
                          minimum=-0.5, maximum=1.0),
            ParameterSpec("servo", gains.servo, "-", f"Frequency at which {joint.name} comes back, by the pendulum's.",
                          minimum=0.0, exclusive_minimum=True, maximum=10.0),
            ParameterSpec("servo_damping", gains.damping, "-", "Its damping ratio.", minimum=0.0, maximum=5.0),
            ParameterSpec("reach", gains.reach, joint.unit, f"Farthest that {joint.name} may go from its goal, and the "
                          "LQR with it; 0 for nine tenths of the way to its stops, where it has some.", minimum=0.0),
            replace(CATCH_Q, default=list(q), unit=""),
            replace(CATCH_R, default=r, unit="", description="Its weight of effort."),
            replace(CATCH_SHARE, description="Share of the sampled region in which it takes over."),
            JOINT_LIMIT,
        )  # fmt: skip

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> JointEnergySwingUp:
        """Return the controller; its region takes a second to sample.

        Raises:
            DesignError: The plant is not supported, or its LQR catches nothing.
        """
        (limit,) = joint_limits(plant, p["effort_limit"])
        joint, (index,) = _driven(plant), plant.coordinates.driven
        if limit <= (friction := plant.joints[index].breakaway):
            raise DesignError(
                f"effort_limit is {limit:g} {joint.effort_unit}; expected more than the friction that holds "
                f"{joint.name}, {friction:g} {joint.effort_unit}"
            )
        gains = replace(
            pump_gains(plant), gain=p["gain"], servo=p["servo"], damping=p["servo_damping"], reach=p["reach"]
        )
        pump = EnergyPump(plant, gains, limit)
        found = make_mechanism_catch(_bounded(plant, pump.reach), p["catch_q"], p["catch_r"], (limit,))
        share = p["catch_share"]
        region = found.region._replace(level=share * found.region.level)
        return cls(plant, pump, p["energy_margin"], replace(found, region=region, leave=found.leave / share))

    def check(self, period: float) -> None:
        """Refuse a period at which the LQR does not settle [s]."""
        require_catching("energy_swing_up", self.catch, period)

    def reset(self) -> None:
        """Start in the swing-up phase."""
        self.catch.active = False
        self.margin.reset()

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the motor's effort."""
        deviation = deviation_of(self._coordinates, position + velocity)
        if self.catch.holds(deviation):
            return self.catch.command(deviation)
        self.margin.learn(*self.pump.swing(position, velocity))
        return (self.pump.effort(position, velocity, self.margin.value),)

    def describe(self) -> str:
        """Return the reach of the driven joint, and the LQR's region."""
        joint = self._coordinates.joints[self._coordinates.driven[0]]
        within = f" within {self.pump.reach:.3g} {joint.unit}" if math.isfinite(self.pump.reach) else ""
        K = ", ".join(f"{value:.4g}" for value in self.catch.gain.K)
        return f"pumps by {joint.name}{within}, LQR K = [{K}] within {self.catch.region.describe()}"

    def take_over(self, previous: Controller) -> None:
        """Take over the margin, and whether the LQR is in charge."""
        if isinstance(previous, JointEnergySwingUp):
            self.margin.take_over(previous.margin)
            self.catch.active = previous.catch.active


def _driven(plant: PlantParameters) -> Any:
    (index,) = plant.coordinates.driven
    return plant.coordinates.joints[index]


def _bounded(plant: PlantParameters, reach: float) -> PlantParameters:
    """Return the plant with stops at the reach of its driven joint."""
    if not math.isfinite(reach):
        return plant
    (index,) = plant.coordinates.driven
    low, high = plant.stops[index]
    name, goal = plant.coordinates.names[index], plant.coordinates.goal[index]
    ends = {"lower_stop": max(low, goal - reach), "upper_stop": min(high, goal + reach)}
    return plant.with_values({f"{name}.{end}": value for end, value in ends.items()})
