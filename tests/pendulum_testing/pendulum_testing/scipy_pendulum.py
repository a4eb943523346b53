"""Recordings of a known pendulum by SciPy alone: no equation, friction law or integrator of the project."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

__all__ = ["coulomb_pendulum", "tones"]

Array = NDArray[np.float64]


def tones(rng: np.random.Generator, amplitude: float, *, lowest: float = 0.3, highest: float = 2.5) -> Callable:
    """Return u(t), a sum of six sines of random phase and peak below ``amplitude`` [N m]."""
    frequency = np.geomspace(lowest, highest, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    return lambda t: amplitude * np.mean(np.sin(2.0 * np.pi * np.multiply.outer(t, frequency) + phase), axis=-1) * 2.0


def coulomb_pendulum(
    drive: Callable,
    time: Array,
    *,
    inertia: float = 0.05,
    damping: float = 0.03,
    gravity: float = 1.5,
    coulomb: float = 0.05,
    start: tuple[float, float] = (0.3, 0.0),
) -> Array:
    """Return the angle at each time [rad]; the joint sticks while |torque - gravity| < coulomb, exactly.

    Between two standstills the sign of the friction is constant: the equation is smooth there, and standstills are
    events of the solver.
    """
    angle, state, now = np.full(time.size, np.nan), np.array(start, dtype=float), float(time[0])

    def load(t: float, theta: float) -> float:
        return float(drive(t)) - gravity * np.sin(theta)

    while now < time[-1]:
        if abs(state[1]) < 1e-9 and abs(load(now, state[0])) <= coulomb:
            grid = np.arange(now, time[-1] + 1e-3, 1e-3)
            free = np.abs(drive(grid) - gravity * np.sin(state[0])) > coulomb
            until = float(grid[np.argmax(free)]) if free.any() else float(time[-1]) + 1e-9
            inside = (time >= now - 1e-12) & (time <= until)
            angle[inside] = state[0]
            now, state = until, np.array([state[0], 0.0])
            if not free.any():
                break
        sign = np.sign(state[1]) if abs(state[1]) > 1e-9 else np.sign(load(now, state[0]))

        def rate(t: float, x: Array, sign: float = sign) -> list[float]:
            return [x[1], (load(t, x[0]) - damping * x[1] - coulomb * sign) / inertia]

        def stop(t: float, x: Array, sign: float = sign, now: float = now) -> float:
            return float(sign * x[1] + 1e-12) if t > now + 1e-6 else 1.0

        stop.terminal, stop.direction = True, -1.0  # type: ignore[attr-defined]
        found = solve_ivp(
            rate, (now, float(time[-1]) + 1e-9), state, events=stop, rtol=1e-9, atol=1e-11, dense_output=True
        )
        inside = (time >= now - 1e-12) & (time <= found.t[-1])
        angle[inside] = found.sol(time[inside])[0]
        now = float(found.t[-1])
        state = np.array([found.y[0, -1], 0.0])
    return angle
