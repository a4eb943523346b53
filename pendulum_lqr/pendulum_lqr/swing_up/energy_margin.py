"""Adaptive energy margin of a swing-up beyond upright, because the model's friction is never exact."""

from __future__ import annotations

__all__ = ["EnergyMargin"]

_NEAR = 1.0
"""Angle from upright within which passing and turning back count [rad]."""
_STEP = 0.005
"""Smallest reduction per pass, also below 0: a plant with less friction than its model spins at margin 0."""
_LEAST, _MOST = -0.2, 1.0


class EnergyMargin:
    """Reduces the margin after passing upright uncaught, increases it after turning back before.

    ``first`` and ``value`` are shares of upright's energy [-]. Below velocity ``rest`` [rad/s], where noise decides the
    direction, the margin is constant.
    """

    def __init__(self, first: float, rest: float = 0.0) -> None:
        self._first = first
        self._rest = rest
        self.reset()

    def reset(self) -> None:
        """Restore the initial margin."""
        self.value = self._first
        self._last: tuple[float, float] | None = None

    def learn(self, angle: float, velocity: float) -> None:
        """Adapt to a state: angle from upright, wrapped [rad], and velocity [rad/s]."""
        if abs(velocity) < self._rest:
            return
        last, self._last = self._last, (angle, velocity)
        if last is None or abs(angle) > _NEAR or abs(last[0]) > _NEAR:
            return
        if angle * last[0] < 0.0:
            self.value = max(self.value - max(0.5 * self.value, _STEP), _LEAST)
        elif velocity * last[1] < 0.0:
            self.value = min(self.value + 0.5 * max(self.value, 0.0) + 2.0 * _STEP, _MOST)

    def take_over(self, previous: EnergyMargin) -> None:
        """Take over the margin of another one."""
        self.value, self._last = previous.value, previous._last
