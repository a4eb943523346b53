"""Linear feedback about a fixed point, of any number of joints: common part of LQR, LQI, discrete LQR, LQG and MPC."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import Law, within_limits
from pendulum_lqr.controller_interface.loop_check import require_settling
from pendulum_lqr.controller_interface.sampling import require_period
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import Gain
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.swing_up.catch import MechanismCatch
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap_angle
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["JOINT_LIMIT", "LinearFeedback", "gain_text", "joint_limits", "require_catching"]

Array = NDArray[np.float64]

JOINT_LIMIT = ParameterSpec(
    "effort_limit", 0.0, "N m", "Largest effort of each driven joint; 0 for the plant's own.", minimum=0.0
)
"""A limit for all driven joints, in addition to their own."""
_SMALLER_Q = "a faster plant, or a smaller q"


def joint_limits(plant: PlantParameters, limit: float) -> Vector:
    """Return the smaller of each driven joint's own limit and the controller's (0 for none) [N m or N, or V]."""
    return tuple(min(limit or math.inf, own) for own in plant.command_limits)


def require_catching(controller: str, catch: MechanismCatch, period: float) -> None:
    """Raise DesignError for an LQR that does not settle upright at a period [s], including lag and delay."""
    require_settling(controller, catch.plant, Feedback(catch.gain.K), period, "a faster plant")


def gain_text(rows: Array | Iterable[Iterable[float]], digits: str = ".6f") -> str:
    """Return the rows of a gain as text."""
    return "; ".join(", ".join(f"{value:{digits}}" for value in row) for row in np.atleast_2d(np.asarray(rows)))


class LinearFeedback(LawController):
    """Feedback of all deviations from a fixed point that the driven joints hold, by the linear model there.

    With one joint it may be a law, which can run compiled; with several it uses matrices.

    Attributes:
        gain: Gain, designed by a subclass.
        model: Linear model at the fixed point.
        hold: The m commands that are fed forward [N m or N, or V].
        position: Fixed point, n values [rad or m].
    """

    BALANCES = True
    IN_VOLTS = True
    SETTLES_BY: ClassVar[str] = ""
    """Action at every state, in refusals of another period; empty if only the gain must settle."""

    gain: Gain

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        Controller.__init__(self, joint_limits(plant, p["effort_limit"]))
        self._plant, self.period = plant, period
        self._offsets = tuple(map(float, np.ravel(p["set_point"])))
        joints = plant.coordinates.joints
        self.position = tuple(joint.goal + offset for joint, offset in zip(joints, self._offsets, strict=True))
        self._origin = tuple((joint.turns, joint.goal, off) for joint, off in zip(joints, self._offsets, strict=True))
        self.effort_limit, self.set_point = self.effort_limits[0], self._offsets[0]
        self.model = linearise(plant, self.position)
        self.equilibrium = np.array(self.model.efforts)
        self.hold = self.equilibrium if p["feedforward"] else np.zeros(len(self.equilibrium))
        self._use(None, ())

    @classmethod
    def own(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return the parameters of this controller alone."""
        return ()

    @classmethod
    def parameters(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return weights, with the plant's defaults, own parameters, feed-forward, set-point and limit."""
        if plant is None or plant.is_pendulum:
            return (Q, R, *cls.own(plant), FEEDFORWARD)
        q, r = plant.weights
        names, what = ", ".join(plant.coordinates.names), "voltage" if plant.coordinates.volts else "effort"
        rest, diagonal = [0.0] * len(plant.joints), f"Diagonal of Q: weights of {names}, then of their velocities."
        return (
            ParameterSpec("q", list(q), "", diagonal, minimum=0.0),
            ParameterSpec("r", r, "", f"Weight of each {what}, R.", minimum=0.0, exclusive_minimum=True),
            *cls.own(plant),
            replace(FEEDFORWARD, description="Whether the efforts that hold the set-point against gravity are added."),
            ParameterSpec("set_point", rest, "", f"Place to hold, from upright: {plant.coordinates.with_units}."),
            replace(JOINT_LIMIT, unit="V") if plant.coordinates.volts else JOINT_LIMIT,
        )

    def check(self, period: float) -> None:
        """Refuse another period than the design's [s], and one at which the gain does not settle.

        For one joint, ``make_controller`` checks it together with its wrappers.
        """
        if self._plant.is_pendulum:
            return
        if self.SETTLES_BY:
            require_period(self.SETTLES_BY, self.period, period)
        if self.feedback is not None:
            # The gain on sums depends on the period.
            name = type(self).__name__.lower()
            require_settling(name, self._plant, self._feedback(period), period, _SMALLER_Q, self.position)

    def _feedback(self, period: float) -> Feedback:
        """Return the gain at a period [s]."""
        assert self.feedback is not None
        return self.feedback

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m commands [N m or N, or V]."""
        if self._direct is not None:  # as in LawController, without a call more
            return (self._direct(t, wrap_angle(position[0] - UPRIGHT), velocity[0], self.memory, self.numbers),)
        if self.law is not None:
            return super().efforts(t, position, velocity)
        return self._answer(self.deviation(position), velocity)

    def deviation(self, position: Vector) -> Vector:
        """Return n deviations from the fixed point; only turning joints are wrapped [rad or m]."""
        # A list is twice as fast as a generator.
        return tuple(
            [
                wrap_angle(wrap_angle(q - goal) - offset) if turns else q - goal - offset
                for q, (turns, goal, offset) in zip(position, self._origin, strict=True)
            ]
        )

    def _answer(self, off: Vector, velocity: Vector) -> Vector:
        """Return the efforts for n deviations and n velocities without a law [N m or N]."""
        raise NotImplementedError(f"{type(self).__name__}._answer")

    def _within(self, wanted: Iterable[float]) -> Vector:
        return within_limits(wanted, self.effort_limits)

    def _be_law(self, law: Law, numbers: Iterable[float], memory: Iterable[float] = ()) -> None:
        """Use a law if the plant has one joint; its memory is also that of the matrices."""
        self._use(law if len(self._offsets) == 1 else None, numbers, memory)

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{gain_text(self.gain.rows)}]"
