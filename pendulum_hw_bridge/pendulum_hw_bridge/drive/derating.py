"""Less torque before none: the limit falls with the winding's temperature, before a hot motor is cut off."""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_msgs_py.errors import ParameterError

__all__ = ["Derating"]


@dataclass(frozen=True)
class Derating:
    """The share of the torque limit that a temperature leaves: 1 up to ``start``, then falling to 0 at ``end``.

    Attributes:
        start: Winding temperature from which on the limit falls; 0 for no derating [degC].
        end: Winding temperature at which nothing is left, that of the cut-off [degC].
    """

    start: float
    end: float

    def __post_init__(self) -> None:
        """Refuse a derating that begins after the cut-off."""
        if self.start and not 0.0 < self.start < self.end:
            raise ParameterError(
                f"derating_temperature is {self.start} degC; expected 0 (none), or > 0 and less than "
                f"winding_temperature_limit = {self.end} degC"
            )

    def share(self, temperature: float) -> float:
        """Return the share of the limit that is left, 0 to 1; of a temperature that is no number, all is left.

        The cut-off, and the fault of a reading that is none, are others' to name.
        """
        if not self.start or not temperature > self.start:
            return 1.0
        return max(0.0, (self.end - temperature) / (self.end - self.start))

    def clamp(self, effort: float, limit: float, temperature: float) -> float:
        """Return a torque within what is left of its limit.

        Args:
            effort: Wanted torque [N m].
            limit: Torque limit of the cold motor [N m].
            temperature: Of the winding [degC].
        """
        left = limit * self.share(temperature)
        return min(left, max(-left, effort))
