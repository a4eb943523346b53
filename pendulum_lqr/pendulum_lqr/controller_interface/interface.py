"""Interface of all controllers: states of n joints in, commands of the m driven ones out: efforts, or volts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pendulum_lqr.linear.analysis import Feedback
from pendulum_msgs_py.contract.angles import UPRIGHT, deviation_from_upright
from pendulum_msgs_py.contract.values import Vector
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["Controller", "unwrapped"]


class Controller:
    """Maps states to efforts. A subclass defines ``efforts``, or for one joint alone ``command``.

    Attributes:
        effort_limits: Largest command of each driven joint [N m or N, or V].
        feedback: Gain near the set-point; None for a law without one.
        inner: Wrapped controller, or None.
    """

    SUMMARY: ClassVar[str] = ""
    """One sentence for tables."""
    PARAMETERS: ClassVar[tuple[ParameterSpec, ...]] = ()
    """Parameters that are the same for every plant."""
    SAMPLED: ClassVar[bool] = True
    """Whether commands depend on the period of states; for others the period is only checked."""
    BALANCES: ClassVar[bool] = False
    """Whether it holds a fixed point, so that it must settle at the period of the states."""
    DESIGNING: ClassVar[str] = ""
    """Log text for a design that takes seconds."""
    PREDICTS: ClassVar[bool] = False
    """Whether it predicts the plant from its own torques, and so needs the holding torque."""
    STARTS_SOFTLY: ClassVar[bool] = False
    """Whether it applies ``start_time`` itself; for others a wrapper does."""
    FEEDBACK: ClassVar[bool] = True
    """Whether it closes a loop whose linear model must be stable."""
    IN_VOLTS: ClassVar[bool] = False
    """Whether its commands to motors are volts; others get the plant behind its motors, and are converted."""
    TIME_INVARIANT: ClassVar[bool] = True
    """Whether commands do not depend on time, so that the loop has a frequency response."""

    feedback: Feedback | None = None
    inner: Controller | None = None
    notice: str = ""
    """Notice for the user while it runs."""

    def __init__(self, effort_limits: Vector) -> None:
        self.effort_limits = effort_limits

    @classmethod
    def parameters(cls, plant: Any) -> tuple[ParameterSpec, ...]:
        """Return the parameters with defaults for a plant, or None for any of one joint."""
        return cls.PARAMETERS

    @classmethod
    def design(cls, plant: Any, period: float, p: Mapping[str, Any]) -> Controller:
        """Return the controller for a plant, by default an instance of the class with these arguments.

        Args:
            plant: Plant.
            period: Period of the states, or an assumed one while it is unknown [s].
            p: Checked values of the common parameters and :meth:`parameters`; of one joint with the final
                ``effort_limit``.

        Raises:
            ParameterError: The values do not make a controller for this plant at this period.
        """
        make: Any = cls
        designed: Controller = make(plant, period, p)
        return designed

    @classmethod
    def judged_at(cls, p: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
        """Return changed parameters for each check of the loop before it moves a plant.

        The holding torque affects the fixed point, not stability, so the loop is checked with feedforward.
        """
        return ({} if p.get("feedforward", True) else {"feedforward": True},)

    def check(self, period: float) -> None:
        """Raise ParameterError if the controller is not for this period of the states [s]."""

    def reset(self) -> None:
        """Reset integrals, filters and phases."""

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the m efforts for a state [N m or N].

        Args:
            t: Time of the state since the start [s]; it increases from call to call.
            position: n positions, hanging at 0 and not wrapped [rad or m].
            velocity: n velocities [rad/s or m/s].
        """
        return (self.command(t, (deviation_from_upright(position[0]), velocity[0])),)

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque of one joint [N m] for x = [wrap(theta - pi) [rad], theta_dot [rad/s]]."""
        return self.efforts(t, (UPRIGHT + x[0],), (x[1],))[0]

    def describe(self) -> str:
        """Return gains and figures in one line, for the log."""
        return type(self).__name__

    def carry_over(self, previous: Controller) -> None:
        """Take over integrals and filters from the replaced controller, so that torque does not jump."""
        self.take_over(unwrapped(previous))

    def take_over(self, previous: Controller) -> None:
        """Take over the state of the previous controller, without wrappers; nothing by default."""


def unwrapped(controller: Controller) -> Controller:
    """Return the innermost controller, without wrappers for velocity and soft start."""
    while controller.inner is not None:
        controller = controller.inner
    return controller
