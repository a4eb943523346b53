"""What every controller offers, whatever plant it is for: states of n joints in, efforts of the m driven ones out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pendulum_lqr.linear.analysis import Feedback
from pendulum_msgs_py.contract.angles import UPRIGHT, deviation_from_upright
from pendulum_msgs_py.contract.values import Vector
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["Controller", "unwrapped"]


class Controller:
    """What turns states into efforts. A subclass defines ``efforts``, or for one joint alone ``command``.

    Attributes:
        effort_limits: Largest effort of each driven joint [N m or N].
        feedback: What it is near its set-point where that is a gain; None for any other law.
        inner: The controller that this one wraps; None for one that computes efforts itself.
    """

    SUMMARY: ClassVar[str] = ""
    """One sentence for tables."""
    PARAMETERS: ClassVar[tuple[ParameterSpec, ...]] = ()
    """Parameters of this controller that are the same for every plant."""
    SAMPLED: ClassVar[bool] = True
    """Whether its commands depend on the period of states; for others the period is only checked."""
    BALANCES: ClassVar[bool] = False
    """Whether it holds one place, so that it must settle at the period at which states come."""
    DESIGNING: ClassVar[str] = ""
    """What its design does, to be logged, where that takes seconds."""
    PREDICTS: ClassVar[bool] = False
    """Whether it predicts the plant from the torques that it sent, and so needs the holding torque."""
    STARTS_SOFTLY: ClassVar[bool] = False
    """Whether it applies ``start_time`` itself; for others a wrapper does."""
    FEEDBACK: ClassVar[bool] = True
    """Whether it closes a loop whose linear model has to be stable."""
    TIME_INVARIANT: ClassVar[bool] = True
    """Whether a state gives the same command at any time, so that the loop has a frequency response."""

    feedback: Feedback | None = None
    inner: Controller | None = None
    notice: str = ""
    """Notice for the user while it runs; empty for nothing."""

    def __init__(self, effort_limits: Vector) -> None:
        self.effort_limits = effort_limits

    @classmethod
    def parameters(cls, plant: Any) -> tuple[ParameterSpec, ...]:
        """Return what can be set, with defaults for a plant, None for any of one joint; ``PARAMETERS`` by default."""
        return cls.PARAMETERS

    @classmethod
    def design(cls, plant: Any, period: float, p: Mapping[str, Any]) -> Controller:
        """Return the controller for a plant; by default what the class makes of these three.

        Args:
            plant: The plant.
            period: Period of the states, or an assumed one while it is unknown [s].
            p: Checked values of the common parameters and :meth:`parameters`; of one joint ``effort_limit`` is already
                the one to keep.

        Raises:
            ParameterError: The values do not make a controller for this plant at this period.
        """
        make: Any = cls
        designed: Controller = make(plant, period, p)
        return designed

    @classmethod
    def judged_at(cls, p: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
        """Return what is set, one judgement after the other, where the loop is judged before it moves a plant.

        Where a loop rests is one thing, whether it is stable another: the holding torque belongs to the first.

        Args:
            p: Checked values of all parameters.
        """
        return ({} if p.get("feedforward", True) else {"feedforward": True},)

    def check(self, period: float) -> None:
        """Refuse a period at which states come and for which this controller is not; any period by default [s].

        Raises:
            ParameterError: It is not for this period.
        """

    def reset(self) -> None:
        """Forget everything: integrals, filters, phases; nothing by default."""

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the m efforts for a state [N m or N].

        Args:
            t: Time of the state since the controller was started [s]; it increases from call to call.
            position: n positions, hanging at 0 and not wrapped [rad or m].
            velocity: n velocities [rad/s or m/s].
        """
        return (self.command(t, (deviation_from_upright(position[0]), velocity[0])),)

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque for a state of the only joint [N m].

        Args:
            t: As of :meth:`efforts`.
            x: [wrap(theta - pi) [rad], theta_dot [rad/s]].
        """
        return self.efforts(t, (UPRIGHT + x[0],), (x[1],))[0]

    def describe(self) -> str:
        """Return gains and figures in one line, for the log."""
        return type(self).__name__

    def carry_over(self, previous: Controller) -> None:
        """Take over integrals and filters from the controller that this one replaces, so that torque does not jump."""
        self.take_over(unwrapped(previous))

    def take_over(self, previous: Controller) -> None:
        """Take over what the previous controller remembers, wrappers apart; nothing by default."""


def unwrapped(controller: Controller) -> Controller:
    """Return the controller itself, without what gives it its velocity and what lets its effort rise."""
    while controller.inner is not None:
        controller = controller.inner
    return controller
