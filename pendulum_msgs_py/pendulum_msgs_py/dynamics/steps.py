"""Shared by the steps of all plants: the lag of an actuator, and the search for an event inside a step."""

from __future__ import annotations

import math

__all__ = ["actuator_torque", "narrowed"]


def actuator_torque(torque: float, command: float, elapsed: float, time_constant: float) -> float:
    """Return the torque of a first-order lag after a time [s], u + (tau - u) exp(-t/T) [N m]; u for T = 0."""
    if time_constant == 0.0:
        return command
    return command + (torque - command) * math.exp(-elapsed / time_constant)


def narrowed(
    low: float, g_low: float, high: float, g_high: float, side: int, root: float, g: float, before: bool
) -> tuple[float, float, float, float, int]:
    """Return the bracket of a root (low, g_low, high, g_high, side) narrowed by an evaluation ``g`` at ``root``.

    ``side`` is the end that moved last, -1 or 1, or 0; ``before`` says whether ``root`` lies before the event. Times in
    s.

    Source:
        The Illinois method: M. Dowell and P. Jarratt, A modified regula falsi method, BIT 11, 1971. An end that stays
        twice counts half, else it would stay forever.
    """
    if before:
        return root, g, high, g_high * 0.5 if side == 1 else g_high, 1
    return low, g_low * 0.5 if side == -1 else g_low, root, g, -1
