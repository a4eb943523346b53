"""What every controller offers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

from pendulum_msgs_py.contract.values import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["Controller", "JointController"]


class Controller(Protocol):
    """What turns states into torques."""

    effort_limit: float

    def reset(self) -> None:
        """Forget everything: integrals, filters, phases."""

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque for a state [N m].

        Args:
            t: Time of the state since the controller was started [s]; it increases from call to call.
            x: [wrap(theta - pi) [rad], theta_dot [rad/s]].
        """

    def describe(self) -> str:
        """Return gains and figures in one line, for the log."""

    def carry_over(self, previous: Controller) -> None:
        """Take over integrals and filters from the controller that this one replaces, so that torque does not jump."""


class JointController:
    """What turns states of several joints into efforts of the driven ones.

    Attributes:
        effort_limits: Largest effort of each driven joint [N m or N].
    """

    SUMMARY: ClassVar[str] = ""
    """One sentence for tables."""
    SAMPLED: ClassVar[bool] = True
    """Whether its commands depend on the period of states; for others the period is only checked."""
    DESIGNING: ClassVar[str] = ""
    """What its design does, to be logged, where that takes seconds."""

    def __init__(self, effort_limits: Vector) -> None:
        self.effort_limits = effort_limits

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return what can be set, with defaults for a plant; nothing by default."""
        return ()

    @classmethod
    def design(cls, plant: MechanismParameters, p: Mapping[str, Any], period: float) -> JointController:
        """Return the controller for a plant; by default what the class makes of these three.

        Args:
            plant: The plant.
            p: Checked values of :meth:`parameters`.
            period: Period of states, or an assumed one while it is unknown [s].

        Raises:
            ParameterError: The values do not make a controller for this plant at this period.
        """
        make: Any = cls
        designed: JointController = make(plant, p, period)
        return designed

    @property
    def notice(self) -> str:
        """Notice for the user while it runs; empty for nothing."""
        return ""

    def check(self, period: float) -> None:
        """Refuse a period at which states come and for which this controller is not; any period by default [s].

        Raises:
            ParameterError: It is not for this period.
        """

    def reset(self) -> None:
        """Forget everything; nothing by default."""

    def command(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the m efforts for a state [N m or N].

        Args:
            t: Time of the state since the controller was started [s]; it increases from call to call.
            position: n positions, not wrapped [rad or m].
            velocity: n velocities [rad/s or m/s].
        """
        raise NotImplementedError(f"{type(self).__name__}.command")

    def describe(self) -> str:
        """Return gains and figures in one line, for the log."""
        return type(self).__name__

    def carry_over(self, previous: Controller | JointController) -> None:
        """Take over what the controller remembers that this one replaces; nothing by default."""
