"""Errors of the project: each names the thing, its value, its unit and what was expected."""

from __future__ import annotations

__all__ = ["BagError", "DataError", "FaultError", "ParameterError", "PendulumError", "PlantStoppedError"]


class PendulumError(Exception):
    """Root of all errors that a user may meet."""


class ParameterError(PendulumError, ValueError):
    """A parameter is missing, has the wrong type or unit, or lies outside its domain."""


class DataError(PendulumError, ValueError):
    """Recorded data (a CSV file, a log, the content of a bag) is malformed."""


class BagError(PendulumError, OSError):
    """A bag cannot be opened, read or written."""


class FaultError(PendulumError, RuntimeError):
    """A plant, node or process cannot do what was requested in its present state."""


class PlantStoppedError(FaultError):
    """A plant stopped torque by itself: ``mode`` is ``fault``, ``e_stop`` or ``disarmed`` (starvation)."""

    def __init__(self, namespace: str, mode: str, reason: str) -> None:
        super().__init__(f"{namespace} went to {mode}: {reason}")
        self.namespace = namespace
        self.mode = mode
        self.reason = reason
