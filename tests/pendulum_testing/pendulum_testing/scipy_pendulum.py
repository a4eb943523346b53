"""Recordings of a known pendulum by SciPy alone: no equation, friction law or integrator of the project."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint, solve_ivp

__all__ = ["coulomb_pendulum", "sampled_pendulum", "tones"]

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


def sampled_pendulum(
    command: Callable[[float, float, float], float],
    time: Array,
    noise: Array,
    *,
    inertia: float,
    damping: float,
    gravity: float,
    coulomb: float,
    start: tuple[float, float],
    push: Callable[[float], float] | None = None,
) -> tuple[Array, Array]:
    """Return the read angle [rad] and the torque held from each sample on [N m].

    Args:
        command: Torque by time [s], read angle [rad] and speed [rad/s].
        time: Of the samples [s].
        noise: Of the read angle, one value for each time [rad].
        inertia: [kg m^2].
        damping: [N m s/rad].
        gravity: [N m].
        coulomb: Dry friction, which turns round within 2 mrad/s [N m].
        start: Angle and speed [rad], [rad/s].
        push: Torque by time that no recording has [N m].
    """
    state, read, torque = np.array(start, dtype=float), np.empty(time.size), np.empty(time.size)

    def rate(x: Array, t: float, u: float) -> list[float]:
        pushed = push(t) if push is not None else 0.0
        dry = coulomb * np.tanh(x[1] / 2e-3)
        return [x[1], (u + pushed - gravity * np.sin(x[0]) - damping * x[1] - dry) / inertia]

    for k, now in enumerate(time):
        read[k] = state[0] + noise[k]
        torque[k] = u = command(float(now), float(read[k]), float(state[1]))
        if k + 1 < time.size:
            state = odeint(rate, state, (now, time[k + 1]), args=(u,), rtol=1e-7, atol=1e-9)[1]
    return read, torque
