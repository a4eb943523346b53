"""Errors of the project: each names the thing, its value, its unit and what was expected."""

from __future__ import annotations

__all__ = ["BagError", "DataError", "FaultError", "ParameterError", "PendulumError", "PlantStoppedError"]


class PendulumError(Exception):
    """Root of all errors that a user of the project may meet and mend."""


class ParameterError(PendulumError, ValueError):
    """A parameter is missing, has the wrong type or unit, or lies outside its domain."""


class DataError(PendulumError, ValueError):
    """Recorded data (a CSV file, a log, the content of a bag) is not what it claims to be."""


class BagError(PendulumError, OSError):
    """A bag cannot be opened, read or written."""


class FaultError(PendulumError, RuntimeError):
    """A plant, a node or a process is in a state in which it cannot do what was asked."""


class PlantStoppedError(FaultError):
    """A plant gave up torque by itself: a fault, an e-stop, or no command for long.

    Args:
        namespace: Of the plant.
        mode: In which it is: ``fault``, ``e_stop`` or ``disarmed``.
        reason: Why, in its own words; a fault of the bridge begins with its name.
    """

    def __init__(self, namespace: str, mode: str, reason: str) -> None:
        super().__init__(f"{namespace} went to {mode}: {reason}")
        self.namespace = namespace
        self.mode = mode
        self.reason = reason
