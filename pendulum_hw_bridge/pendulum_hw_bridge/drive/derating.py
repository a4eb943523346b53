"""Derating: the torque limit falls with the winding temperature before the cut-off disarms a hot motor."""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_msgs_py.errors import ParameterError

__all__ = ["Derating"]


@dataclass(frozen=True)
class Derating:
    """Torque limit as a function of winding temperature: full up to ``start``, then linear to 0 at ``end``.

    Attributes:
        start: Winding temperature at which derating starts; 0 disables it [degC].
        end: Winding temperature of the cut-off [degC].
    """

    start: float
    end: float

    def __post_init__(self) -> None:
        if self.start and not 0.0 < self.start < self.end:
            raise ParameterError(
                f"derating_temperature is {self.start} degC; expected 0 (none), or > 0 and less than "
                f"winding_temperature_limit = {self.end} degC"
            )

    def share(self, temperature: float) -> float:
        """Return the remaining share of the limit, 0 to 1; 1 for NaN, which the safety monitor reports."""
        if not self.start or not temperature > self.start:
            return 1.0
        return max(0.0, (self.end - temperature) / (self.end - self.start))

    def clamp(self, effort: float, limit: float, temperature: float) -> float:
        """Return a torque within the derated limit [N m]; ``temperature`` is the winding's [degC]."""
        left = limit * self.share(temperature)
        return min(left, max(-left, effort))
