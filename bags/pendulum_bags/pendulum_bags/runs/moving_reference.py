"""The moving reference that a controller followed in a recorded run, from its parameters and its first answer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.runs.run_record import record_named, run_record
from pendulum_lqr.linear.reference import Reference

__all__ = ["follows_reference", "recorded_reference"]

_KIND = "lqr_tracking"
_FIELDS = {"reference": str, "set_point": float, "amplitude": float, "frequency": float, "move_time": float}


def follows_reference(metadata: Mapping[str, Any], space: str) -> bool:
    """Return whether the controller of a recorded run followed a moving reference."""
    recorded = _parameters(metadata, space)
    kinds = {recorded.get("controller"), record_named(run_record(metadata), "controller").get("kind")}
    return _KIND in kinds and recorded.get("amplitude") != 0.0


def recorded_reference(
    metadata: Mapping[str, Any], space: str, times: NDArray[np.float64], first_answer: float
) -> NDArray[np.float64] | None:
    """Return the reference of the angle at some times [s], from upright, shape (n,) [rad], or None if it did not move.

    Also None if the bag lacks its parameters or its beginning. The approach, in the first second or so after
    ``first_answer`` [s], is not included.
    """
    if not follows_reference(metadata, space):
        return None
    recorded = _parameters(metadata, space)
    counts = record_named(record_named(metadata, "pendulum.recorder.counts"), f"{space}/effort_command")
    if counts.get("before"):
        return None
    try:
        values = [kind(recorded[name]) for name, kind in _FIELDS.items()]
    except (KeyError, TypeError, ValueError):
        return None
    reference = Reference(*values)
    if not reference.frequency > 0.0:
        return None
    return np.array([reference.at(float(t) - first_answer).angle for t in times])


def _parameters(metadata: Mapping[str, Any], space: str) -> Mapping[str, Any]:
    return record_named(record_named(metadata, "pendulum.parameters"), f"{space}/controller")
