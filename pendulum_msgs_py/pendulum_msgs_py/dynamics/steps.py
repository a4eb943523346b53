"""What the steps of every plant share: the lag of an actuator, and the search for an event inside a step."""

from __future__ import annotations

import math

__all__ = ["actuator_torque", "narrowed"]


def actuator_torque(torque: float, command: float, elapsed: float, time_constant: float) -> float:
    """Return the torque of a first-order lag, u + (tau - u) exp(-t/T); the command itself for T = 0 [N m].

    Args:
        torque: Torque at the start [N m].
        command: Constant command u [N m].
        elapsed: Time since the start [s].
        time_constant: T [s].
    """
    if time_constant == 0.0:
        return command
    return command + (torque - command) * math.exp(-elapsed / time_constant)


def narrowed(
    low: float, g_low: float, high: float, g_high: float, side: int, root: float, g: float, before: bool
) -> tuple[float, float, float, float, int]:
    """Return the bracket of a root, narrowed: (low, g_low, high, g_high, side).

    Args:
        low: Time before the root [s].
        g_low: The function there.
        high: Time after it [s].
        g_high: The function there.
        side: Which end moved last, -1 or 1; 0 for none.
        root: Time at which the function was evaluated [s].
        g: The function there.
        before: Whether that is before the root.

    Source:
        The Illinois method: M. Dowell and P. Jarratt, A modified regula falsi method, BIT 11, 1971. The end that stays
        twice counts half, else it would stay for ever.
    """
    if before:
        return root, g, high, g_high * 0.5 if side == 1 else g_high, 1
    return low, g_low * 0.5 if side == -1 else g_low, root, g, -1
