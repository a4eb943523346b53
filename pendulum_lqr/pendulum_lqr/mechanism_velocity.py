"""Velocities of the joints from their positions, for a controller whose measured velocities are noisy."""

from __future__ import annotations

from pendulum_lqr.mechanism_controller import MechanismController
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["DifferencedVelocity"]


class DifferencedVelocity:
    """Gives a controller velocities from the last two positions in the place of the measured ones.

    The slope between two positions is the velocity in their middle; half a period of the model's acceleration brings
    it to the end. That is exact to the period's square, and as good as the positions are: an encoder's steps over the
    period come through as noise.

    Args:
        plant: The plant.
        controller: Who is given them.
    """

    def __init__(self, plant: MechanismParameters, controller: MechanismController) -> None:
        self.plant, self.controller = plant, controller
        self.reset()

    def reset(self) -> None:
        """Forget the last position; the first velocity is the measured one."""
        self.controller.reset()
        self._last: tuple[float, Vector] | None = None
        self._effort = (0.0,) * len(self.plant.effort_limits)

    def command(self, t: float, x: Vector) -> Vector:
        """Return the controller's efforts [N m or N]."""
        n = len(self.plant.joints)
        q, v = x[:n], x[n:]
        if self._last is not None and t > self._last[0]:
            before, old = self._last
            h = t - before
            slope = tuple((new - was) / h for new, was in zip(q, old, strict=True))
            a = self.plant.acceleration(q, slope, self.plant.coordinates.spread(self._effort))
            v = tuple(middle + 0.5 * h * each for middle, each in zip(slope, a, strict=True))
        self._last = (t, q)
        self._effort = self.controller.command(t, (*q, *v))
        return self._effort
