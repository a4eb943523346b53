"""Machines of two joints that an LQR holds upright under noise, by programs that share no code with the product.

The equations are written out here, dry friction is Moreau's time stepping (an impulse within +-h F that stops the joint
if it can), the LQR is scipy's. Encoders round, velocities have white noise, and the torque comes late and lags.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from scipy.linalg import solve_continuous_are

__all__ = ["PRESETS", "BalancedRun", "run_balanced"]

PERIOD, STEP = 0.002, 5e-6
"""Of the samples and of the emulation [s]: where a joint turns round, a step errs by 2 F STEP in momentum at most."""
DELAY, LEAD, LAG = 0.0044, 0.0005, 0.001
"""From the state to the start of its torque, from the measurement to the state, and time constant of the torque [s]."""

_TWO_LINKS = {
    "mass_1": 0.5234602302310271, "length_1": 0.2, "centre_1": 0.2, "inertia_1": 0.031887199591513114,
    "mass_2": 0.6255677234174437, "centre_2": 0.25569305436052964, "inertia_2": 0.05086984812807257, "gravity": 9.81,
    "rotor_inertia": 6.287203962819607e-05, "gear_ratio": 6.0, "shoulder.damping": 0.001, "elbow.damping": 0.001,
    "shoulder.coulomb_friction": 0.16, "elbow.coulomb_friction": 0.12,
}  # fmt: skip
_CART = {
    "cart_mass": 1.0, "pole_mass": 0.1, "pole_centre": 0.5, "pole_inertia": 0.1 / 3.0, "gravity": 9.81,
    "cart.damping": 5e-4, "pole.damping": 2e-6, "cart.coulomb_friction": 0.0, "pole.coulomb_friction": 0.0,
}  # fmt: skip
_FURUTA = {
    "arm_inertia": 2.334e-4, "arm_length": 0.085, "pendulum_mass": 0.024, "pendulum_centre": 0.0645,
    "pendulum_inertia": 1.33128e-4, "gravity": 9.81, "arm.damping": 2.7e-4, "pendulum.damping": 5e-5,
    "arm.coulomb_friction": 0.0, "pendulum.coulomb_friction": 0.0,
}  # fmt: skip
_UPRIGHT = ((10.0, 10.0, 1.0, 1.0), 1.0)
PRESETS: dict[str, tuple[int, dict[str, float], tuple[int, ...], float, tuple[float, float], Any]] = {
    "cart_pole": (0, _CART, (0,), 10.0, (0.0, math.pi), ((10.0, 100.0, 1.0, 1.0), 0.1)),
    "furuta": (1, _FURUTA, (0,), 0.09, (0.0, math.pi), ((1.0, 10.0, 0.1, 0.1), 100.0)),
    "acrobot": (2, _TWO_LINKS, (1,), 6.0, (math.pi, 0.0), _UPRIGHT),
    "pendubot": (2, _TWO_LINKS, (0,), 6.0, (math.pi, 0.0), _UPRIGHT),
    "double_pendulum": (2, _TWO_LINKS, (0, 1), 6.0, (math.pi, 0.0), _UPRIGHT),
}
"""By preset: its kind, nominal values, driven joints, effort limit, upright position, weights of states and effort."""


@dataclass(frozen=True)
class BalancedRun:
    """What was recorded, sampled every ``PERIOD``, and the machine's values.

    Attributes:
        position: Shape (s, 2) [rad or m]; shorter than asked where the machine fell.
        velocity: The same [rad/s or m/s].
        effort: Commanded from each sample to the next, shape (s, 2).
        truth: Values that explain the motion with the nominal masses and gears.
    """

    position: Any
    velocity: Any
    effort: Any
    truth: dict[str, float]


@njit(cache=True)
def _terms(kind: int, p: Any, q: Any, v: Any) -> Any:
    """Return M_11, M_12, M_22 and the efforts of gravity, damping and rotation."""
    s, c = math.sin(q[1]), math.cos(q[1])
    if kind == 0:
        total, m, r, i, g = p[0] + p[1], p[1], p[2], p[3], p[4]
        return total, m * r * c, i, m * r * s * v[1] ** 2 - p[5] * v[0], -m * g * r * s - p[6] * v[1]
    if kind == 1:
        m, r, i, g = p[2], p[3], p[4], p[5]
        h = m * p[1] * r
        f_1 = -p[6] * v[0] - 2.0 * i * s * c * v[0] * v[1] + h * s * v[1] ** 2
        f_2 = -p[7] * v[1] + i * s * c * v[0] ** 2 - m * g * r * s
        return p[0] + m * p[1] ** 2 + i * s * s, h * c, i, f_1, f_2
    m_1, l_1, r_1, i_1, m_2, r_2, i_2, g, rotor, gear = p[:10]
    h = m_2 * l_1 * r_2
    lower = m_2 * g * r_2 * math.sin(q[0] + q[1])
    upper = g * (m_1 * r_1 + m_2 * l_1) * math.sin(q[0])
    return (
        i_1 + i_2 + m_2 * l_1 * l_1 + 2.0 * h * c + (gear * gear + 1.0) * rotor,
        i_2 + h * c - gear * rotor,
        i_2 + gear * gear * rotor,
        h * s * (2.0 * v[0] * v[1] + v[1] ** 2) - upper - lower - p[10] * v[0],
        -h * s * v[0] ** 2 - lower - p[11] * v[1],
    )


@njit(cache=True)
def _run(
    kind: int, p: Any, friction: Any, driven: Any, gain: Any, goal: Any, noise: Any, limit: float, step: Any, blur: Any
) -> Any:
    steps, inner = len(blur), round(PERIOD / STEP)
    late, lead = round(DELAY / STEP), round(LEAD / STEP)
    q, v, lagging = goal.copy(), np.zeros(2), np.zeros(2)
    seen_q, seen_v = q.copy(), v.copy()
    position, velocity, effort = np.zeros((steps, 2)), np.zeros((steps, 2)), np.zeros((steps, 2))
    decay = math.exp(-STEP / LAG)
    for k in range(steps):
        position[k] = np.round(seen_q / step) * step
        velocity[k] = seen_v + blur[k]
        for a in range(driven.size):
            u = noise[k // 5, a] - gain[a, :2] @ (position[k] - goal) - gain[a, 2:] @ velocity[k]
            effort[k, driven[a]] = min(limit, max(-limit, u)) if k > 0 else 0.0
        for j in range(inner):
            fine = k * inner + j - late
            command = effort[fine // inner] if fine >= 0 else np.zeros(2)
            torque = command + (lagging - command) * (1.0 - decay) * LAG / STEP
            lagging = command + (lagging - command) * decay
            half = q + 0.5 * STEP * v
            w, pace = v.copy(), v.copy()
            for stage in range(2):
                m_11, m_12, m_22, f_1, f_2 = _terms(kind, p, half, pace)
                det = m_11 * m_22 - m_12 * m_12
                a_11, a_12, a_22 = m_22 / det, -m_12 / det, m_11 / det
                w[0] = v[0] + STEP * (a_11 * (f_1 + torque[0]) + a_12 * (f_2 + torque[1]))
                w[1] = v[1] + STEP * (a_12 * (f_1 + torque[0]) + a_22 * (f_2 + torque[1]))
                pace = 0.5 * (v + w)
                if friction[0] > 0.0 and stage == 0:
                    pace = v.copy()
            r_1, r_2 = 0.0, 0.0
            for _ in range(30 if friction[0] > 0.0 else 0):
                was = r_1 + r_2
                most = STEP * friction[0]
                r_1 = min(most, max(-most, r_1 - (w[0] + a_11 * r_1 + a_12 * r_2) / a_11))
                most = STEP * friction[1]
                r_2 = min(most, max(-most, r_2 - (w[1] + a_12 * r_1 + a_22 * r_2) / a_22))
                if abs(r_1 + r_2 - was) < 1e-14:
                    break
            w[0] += a_11 * r_1 + a_12 * r_2
            w[1] += a_12 * r_1 + a_22 * r_2
            q = q + 0.5 * STEP * (v + w)
            v = w
            if j == inner - lead - 1:
                seen_q, seen_v = q.copy(), v.copy()
        if not np.max(np.abs(q - goal)) < 1.2:
            return position[:k], velocity[:k], effort[:k]
    return position, velocity, effort


def _gain(kind: int, p: Any, viscous: Any, driven: tuple[int, ...], goal: Any, weights: Any) -> Any:
    small, rest = 1e-6, np.zeros(2)
    m_11, m_12, m_22, _, _ = _terms(kind, p, goal, rest)
    inverse = np.linalg.inv([[m_11, m_12], [m_12, m_22]])
    a = np.zeros((4, 4))
    a[:2, 2:] = np.eye(2)
    for i in range(2):
        d = small * np.eye(2)[i]
        a[2:, i] = inverse @ np.subtract(_terms(kind, p, goal + d, rest)[3:], _terms(kind, p, goal - d, rest)[3:])
        a[2:, 2 + i] = inverse @ np.subtract(_terms(kind, p, goal, d)[3:], _terms(kind, p, goal, -d)[3:])
    a[2:] /= 2.0 * small
    a[2:, 2:] -= inverse @ np.diag(viscous)
    b = np.vstack((np.zeros((2, len(driven))), inverse[:, driven]))
    q, r = weights
    return b.T @ solve_continuous_are(a, b, np.diag(q), r * np.eye(len(driven))) / r


def run_balanced(preset: str, seed: int, duration: float = 20.0) -> BalancedRun:
    """Return a run of a machine whose values are up to 5 % off the preset's, under a controller for the preset."""
    kind, nominal, driven, limit, upright, weights = PRESETS[preset]
    rng, goal, names = np.random.default_rng([seed, 77]), np.array(upright), list(nominal)
    own = len(names) - 2
    p, friction = np.array(list(nominal.values())[:own]), np.array(list(nominal.values())[own:])
    # As the product does, a passive joint's dry friction counts as viscous at 0.5 rad/s in the design.
    viscous = np.array([0.0 if i in driven else friction[i] / 0.5 for i in range(2)])
    gain = np.ascontiguousarray(_gain(kind, p, viscous, driven, goal, weights))
    true = {
        n: value * (1.0 if n in {"gravity", "gear_ratio"} else 1.0 + rng.uniform(-0.05, 0.05))
        for n, value in nominal.items()
    }
    steps = round(duration / PERIOD)
    noise = 0.1 * limit * rng.uniform(-1.0, 1.0, (steps // 5 + 1, len(driven)))
    noise[:, 1:] = 0.0
    scale = np.array([0.02 if preset == "cart_pole" else 1.0, 1.0])
    step = 2.0 * math.pi / 16384.0 * scale / [6.0 if i in driven else 1.0 for i in range(2)]
    blur = 2e-3 * scale * rng.standard_normal((steps, 2))
    values = np.array(list(true.values()))
    found = _run(kind, values[:own], values[own:], np.array(driven), gain, goal, noise, limit, step, blur)
    position, velocity, effort = found
    return BalancedRun(
        position, velocity, effort, {**_as_fitted(kind, nominal, true), "delay": DELAY + LEAD, "time_constant": LAG}
    )


def _as_fitted(kind: int, nominal: dict[str, float], true: dict[str, float]) -> dict[str, float]:
    """Return values of the same motion with the masses of the preset, which no motion tells from others."""
    found = dict(true)
    if kind == 0:
        found["cart_mass"] += true["pole_mass"] - nominal["pole_mass"]
        found["pole_centre"] *= true["pole_mass"] / nominal["pole_mass"]
        return found
    if kind == 1:
        more = true["pendulum_mass"] - nominal["pendulum_mass"]
        found["arm_inertia"] += more * true["arm_length"] ** 2
        found["pendulum_centre"] *= true["pendulum_mass"] / nominal["pendulum_mass"]
        return found
    more = true["mass_2"] - nominal["mass_2"]
    found["centre_2"] *= true["mass_2"] / nominal["mass_2"]
    found["inertia_1"] += more * true["length_1"] ** 2
    found["centre_1"] = (true["mass_1"] * true["centre_1"] + more * true["length_1"]) / nominal["mass_1"]
    return found
