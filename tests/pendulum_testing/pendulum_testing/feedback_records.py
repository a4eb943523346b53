"""Feedback records made by hand, for tests of what judges them; pure."""

from __future__ import annotations

from typing import Any

from pendulum_hw_bridge.port.actuator import FEEDBACK_QUANTITIES, Feedback

__all__ = ["feedback_record"]


def feedback_record(time_ns: int = 0, sequence: int = 0, **given: Any) -> Feedback:
    """Return a record of a module at rest at 36 V and 25 degC, except for what is given.

    Args:
        time_ns: Of receipt and of measurement [ns].
        sequence: Number of the record.
        given: Fields by name.
    """
    fields = dict.fromkeys(FEEDBACK_QUANTITIES, 0.0) | {"voltage": 36.0, "winding_temperature": 25.0}
    return Feedback(**{"stamp_ns": time_ns, "hardware_ns": time_ns, "sequence": sequence, **fields, **given})
