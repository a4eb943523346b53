"""How far beyond the energy of upright a swing-up aims: learnt, since the model's friction is never exact."""

from __future__ import annotations

__all__ = ["EnergyMargin"]

_NEAR = 1.0
"""Angle from upright within which passing and turning back count [rad]."""
_STEP = 0.005
"""What a pass takes off at least, beyond 0 too: a plant with less friction than its model spins at a margin of 0."""
_LEAST, _MOST = -0.2, 1.0


class EnergyMargin:
    """Aims lower after passing upright uncaught, higher after turning back before it.

    Args:
        first: Margin at the start, as a share of the energy of upright [-].
        rest: Velocity below which noise decides the direction, and the margin stays [rad/s].

    Attributes:
        value: The margin [-].
    """

    def __init__(self, first: float, rest: float = 0.0) -> None:
        self._first = first
        self._rest = rest
        self.reset()

    def reset(self) -> None:
        """Forget what was learnt."""
        self.value = self._first
        self._last: tuple[float, float] | None = None

    def learn(self, angle: float, velocity: float) -> None:
        """Take note of a state: angle from upright, wrapped [rad], and velocity [rad/s]."""
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
        """Take over what another one learnt."""
        self.value, self._last = previous.value, previous._last
