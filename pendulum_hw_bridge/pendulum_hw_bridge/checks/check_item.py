"""Items of the checklist."""

from __future__ import annotations

from dataclasses import dataclass, field

from pendulum_hw_bridge.port.actuator import ActuatorError
from pendulum_msgs_py.errors import PendulumError

__all__ = ["HOST_ITEM", "CheckItem", "Checklist", "error_item"]

HOST_ITEM = "this computer keeps time"
"""Name of the one item that is not about the actuator."""


@dataclass(frozen=True)
class CheckItem:
    """One item; ``passed`` is None if not judged or not tried, ``hint`` says what to do if it has not passed."""

    name: str
    passed: bool | None
    seen: str
    expected: str
    hint: str = ""


def error_item(error: PendulumError) -> CheckItem:
    """Return the item of an error that ended the check of a module."""
    return CheckItem(error.fault if isinstance(error, ActuatorError) else "parameter", False, str(error), "no error")


@dataclass
class Checklist:
    """Results of the checklist; ``figures`` (rate [Hz], jitter, latencies, loss) by name with unit."""

    items: list[CheckItem] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    host_busy: bool = False

    @property
    def ready(self) -> bool:
        """Whether arming is permitted."""
        return not self.host_busy and not self.refused

    @property
    def refused(self) -> bool:
        """Whether an item failed for another reason than this computer being busy."""
        return any(item.passed is False and item.name != HOST_ITEM for item in self.items)

    @property
    def untried(self) -> list[str]:
        """Names of items that were not tried."""
        return [item.name for item in self.items if item.passed is None]
