"""Region of attraction of u = clamp(-K x) under the torque limit: a proven part, and the whole by sampling.

The proven part is a sublevel set of the Riccati solution's Lyapunov function V = x' S x. In the coordinates x = rho
n(phi) with n' S n = 1, so that V = rho^2,

    V' / rho^2 = 2 n' S [n_1, (-b n_1 - G n_0 g(rho n_0) + clamp(-K n, limits / rho)) / M]
    g(z) = (sin(theta* + z) - sin theta*) / z,   -sinc(z) at upright

is bounded by interval arithmetic over cells of (rho, phi), which are split until every bound is negative. The quotient
has no singularity at rho = 0, so the proof covers the whole ellipse.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_lqr.linear.design import DesignError, Gain
from pendulum_lqr.linear.model import RigidPlant, equilibrium_effort, state_derivative
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap

__all__ = ["Region", "Rollout", "proven_level", "region_of_attraction", "rigid_rollout", "sublevel_ellipse"]

Array = NDArray[np.float64]

Rollout = Callable[[Array, Array], tuple[Array, Array]]
"""Batch simulation: start angles (from upright [rad]) and velocities [rad/s], shape (n,), to those at the end."""

_ARRIVED = (0.05, 0.1)
"""|angle| [rad] and |velocity| [rad/s] that count as arrived. A full turn away is a fall."""
_SPLITS = 14
_MOST_CELLS = 400_000
# Bound on the rounding of a dozen operations on doubles, relative to the terms summed.
_ROUNDING = 1e-12


class _Loop(NamedTuple):
    """Plant of the proof; limits are those of the deviation from the holding torque."""

    inertia: float
    damping: float
    gravity: float
    angle: float
    low: float
    high: float


class _Interval(NamedTuple):
    low: Array
    high: Array


@dataclass(frozen=True, slots=True)
class Region:
    """Region of attraction of one closed loop.

    Attributes:
        angles: Grid of start angles from upright, shape (n,) [rad].
        velocities: Grid of start velocities, shape (m,) [rad/s].
        attracted: Whether upright was reached, shape (m, n).
        level: c of the proven sublevel set x' S x <= c.
        ellipse: Its boundary, shape (k, 2) [rad, rad/s].
        S: Lyapunov matrix, shape (2, 2).
    """

    angles: Array
    velocities: Array
    attracted: NDArray[np.bool_]
    level: float
    ellipse: Array
    S: Array

    @property
    def area(self) -> float:
        """Area of the sampled region within the grid [rad^2/s]."""
        cell = (self.angles[1] - self.angles[0]) * (self.velocities[1] - self.velocities[0])
        return float(np.count_nonzero(self.attracted) * cell)

    def counterexamples(self) -> int:
        """Return the number of samples in the proven set that were not attracted; any shows an error."""
        x, v = np.meshgrid(self.angles, self.velocities)
        S = self.S
        value = S[0, 0] * x * x + 2.0 * S[0, 1] * x * v + S[1, 1] * v * v
        return int(np.count_nonzero((value <= self.level) & ~self.attracted))


def proven_level(plant: RigidPlant, gain: Gain, effort_limit: float, theta: float = UPRIGHT) -> float:
    """Return the largest c for which {x' S x <= c} is proven attracted to a fixed point [rad]; 0 without a proof.

    Without dry friction (with which a pendulum comes to rest near the fixed point), lag, delay and drivetrain; with
    ``angle_offset`` and ``torque_offset``. The gain is the LQR's there; ``effort_limit`` in [N m].

    Raises:
        DesignError: The limit is not positive, or too small to hold the fixed point.
    """
    if not effort_limit > 0.0:
        raise DesignError(f"effort_limit is {effort_limit} N m; expected > 0")
    hold = equilibrium_effort(plant, theta)
    if abs(hold) >= effort_limit:
        raise DesignError(
            f"holding {theta - UPRIGHT:.4g} rad from upright takes {hold:.4g} N m; expected less than effort_limit = "
            f"{effort_limit:g} N m"
        )
    directions = np.linalg.inv(scipy.linalg.cholesky(gain.S, lower=True)).T
    loop = _Loop(
        plant.inertia,
        plant.damping,
        plant.gravity,
        theta - float(getattr(plant, "angle_offset", 0.0)),
        -effort_limit - hold,
        effort_limit - hold,
    )
    # The ellipse must not extend around a full turn, where the angle wraps.
    reach = math.pi / float(np.linalg.norm(directions[0]))
    low, high = 0.0, reach
    if _decreases(loop, gain, directions, reach):
        return reach * reach
    # If a thousandth of the reach fails, all fail: a dozen more attempts would only take seconds.
    if not _decreases(loop, gain, directions, 1e-3 * reach):
        return 0.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        if _decreases(loop, gain, directions, middle):
            low = middle
        else:
            high = middle
    return low * low


def sublevel_ellipse(S: Array, level: float, points: int = 361) -> Array:
    """Return the closed curve x' S x = level, shape (points, 2)."""
    directions = np.linalg.inv(scipy.linalg.cholesky(S, lower=True)).T
    phi = np.linspace(0.0, 2.0 * math.pi, points)
    return np.asarray(math.sqrt(level) * (directions @ np.vstack([np.cos(phi), np.sin(phi)])).T, dtype=np.float64)


def region_of_attraction(
    plant: RigidPlant,
    gain: Gain,
    effort_limit: float,
    rollout: Rollout,
    *,
    velocity_span: float = 10.0,
    points: int = 101,
) -> Region:
    """Sample the region of attraction of upright by batch simulation and prove its inner part.

    ``effort_limit`` in [N m]. The grid has half widths pi and ``velocity_span`` [rad/s]; an odd
    number of points includes upright. ``rollout`` must be long enough to settle.
    """
    angles = np.linspace(-math.pi, math.pi, points)
    velocities = np.linspace(-velocity_span, velocity_span, points)
    x, v = np.meshgrid(angles, velocities)
    end_angle, end_velocity = rollout(x.ravel(), v.ravel())
    arrived = (np.abs(wrap(np.asarray(end_angle, dtype=np.float64))) < _ARRIVED[0]) & (
        np.abs(end_velocity) < _ARRIVED[1]
    )
    level = proven_level(plant, gain, effort_limit)
    return Region(angles, velocities, arrived.reshape(x.shape), level, sublevel_ellipse(gain.S, level), gain.S)


def rigid_rollout(plant: RigidPlant, gain: Gain, effort_limit: float, duration: float = 8.0) -> Rollout:
    """Return a batch simulation [s] of the smooth rigid plant under u = clamp(u* - K x) [N m], with wrapped angles.

    Exponential midpoint rule: damping, the fast pole of a stiff plant, is exact, so that the slow motion sets the step.
    For plants with friction use the simulator's batch engine.
    """
    k0, k1 = (float(value) for value in gain.K)
    hold = equilibrium_effort(plant, UPRIGHT)
    stiffness = abs(k0) + plant.gravity
    slow = math.sqrt(stiffness / plant.inertia)
    if plant.damping > 0.0:
        slow = min(slow, stiffness / plant.damping)
    steps = max(math.ceil(duration * max(abs(k1) / plant.inertia, slow) / 0.05), 1)
    h = duration / steps

    def weights(step: float) -> tuple[float, float, float]:
        """Return exp(-z) and the integrals of a constant acceleration, to velocity and to angle."""
        z = plant.damping / plant.inertia * step
        first = -math.expm1(-z) / z if z > 1e-6 else 1.0 - 0.5 * z
        second = (1.0 - first) / z if z > 1e-6 else 0.5
        return math.exp(-z), first * step, second * step * step

    half, whole = weights(0.5 * h), weights(h)

    def drive(x: Array, v: Array) -> Array:
        u = np.clip(hold - k0 * wrap(x) - k1 * v, -effort_limit, effort_limit)
        return np.asarray(state_derivative(plant, x + UPRIGHT, v, u + plant.damping * v)[1])

    def run(angle: Array, velocity: Array) -> tuple[Array, Array]:
        x, v = np.array(angle, dtype=np.float64), np.array(velocity, dtype=np.float64)
        for _ in range(steps):
            f = drive(x, v)
            f = drive(x + half[1] * v + half[2] * f, half[0] * v + half[1] * f)
            x = x + whole[1] * v + whole[2] * f
            v = whole[0] * v + whole[1] * f
        return np.asarray(wrap(x)), v

    return run


def _decreases(loop: _Loop, gain: Gain, directions: Array, reach: float) -> bool:
    """Return whether V' < 0 is proven for all 0 <= rho <= reach and all directions."""
    # At upright without offsets, x and -x are symmetric, so half a turn suffices.
    alike = loop.angle == UPRIGHT and loop.low == -loop.high
    rho = np.linspace(0.0, reach, 33)
    phi = np.linspace(0.0, math.pi, 129) if alike else np.linspace(-math.pi, math.pi, 257)
    r_low, p_low = (grid.ravel() for grid in np.meshgrid(rho[:-1], phi[:-1]))
    r_high, p_high = (grid.ravel() for grid in np.meshgrid(rho[1:], phi[1:]))
    for _ in range(_SPLITS):
        bound = _rate(loop, gain, directions, _Interval(r_low, r_high), _Interval(p_low, p_high)).high
        open_cells = bound >= 0.0
        if not np.any(open_cells):
            return True
        r_low, r_high, p_low, p_high = (edge[open_cells] for edge in (r_low, r_high, p_low, p_high))
        r_middle, p_middle = 0.5 * (r_low + r_high), 0.5 * (p_low + p_high)
        centre = _rate(loop, gain, directions, _Interval(r_middle, r_middle), _Interval(p_middle, p_middle))
        if np.any(centre.low >= 0.0) or 4 * r_low.size > _MOST_CELLS:
            return False
        r_low, r_high = (
            np.concatenate([r_low, r_low, r_middle, r_middle]),
            np.concatenate([r_middle, r_middle, r_high, r_high]),
        )
        p_low, p_high = (
            np.concatenate([p_low, p_middle, p_low, p_middle]),
            np.concatenate([p_middle, p_high, p_middle, p_high]),
        )
    return False


def _rate(loop: _Loop, gain: Gain, directions: Array, rho: _Interval, phi: _Interval) -> _Interval:
    """Return bounds of V' / rho^2 over cells."""
    n0 = _direction(directions[0], phi)
    n1 = _direction(directions[1], phi)
    s0 = _direction(gain.S[0] @ directions, phi)
    s1 = _direction(gain.S[1] @ directions, phi)
    feedback = _direction(-np.asarray(gain.K) @ directions, phi)
    # clamp shrinks as rho grows: the widest clamp belongs to the smallest rho.
    wide, narrow = np.maximum(rho.low, 1e-300), np.maximum(rho.high, 1e-300)
    u_low = np.minimum(
        np.clip(feedback.low, loop.low / wide, loop.high / wide),
        np.clip(feedback.low, loop.low / narrow, loop.high / narrow),
    )
    u_high = np.maximum(
        np.clip(feedback.high, loop.low / wide, loop.high / wide),
        np.clip(feedback.high, loop.low / narrow, loop.high / narrow),
    )
    # Away from zero the clamp moves both ends towards zero; the two candidates above cover either sign.
    weight = _times(n0, _weight_quotient(loop.angle, rho, n0))
    torque = _Interval(
        u_low - loop.gravity * weight.high - loop.damping * n1.high,
        u_high - loop.gravity * weight.low - loop.damping * n1.low,
    )
    first = _times(s0, n1)
    second = _times(s1, torque)
    size = np.abs(first.low) + np.abs(first.high) + (np.abs(second.low) + np.abs(second.high)) / loop.inertia
    return _Interval(
        2.0 * (first.low + second.low / loop.inertia) - _ROUNDING * size,
        2.0 * (first.high + second.high / loop.inertia) + _ROUNDING * size,
    )


def _direction(row: Array, phi: _Interval) -> _Interval:
    """Return bounds of row . [cos phi, sin phi] = a cos(phi - shift) over intervals of phi."""
    amplitude = math.hypot(float(row[0]), float(row[1]))
    shift = math.atan2(float(row[1]), float(row[0]))
    low, high = phi.low - shift, phi.high - shift
    at_low, at_high = np.cos(low), np.cos(high)
    smallest, largest = np.minimum(at_low, at_high), np.maximum(at_low, at_high)
    # An extremum is inside if an even or odd multiple of pi lies between the ends.
    crest = np.floor(high / (2.0 * math.pi)) > np.floor(low / (2.0 * math.pi))
    trough = np.floor(high / (2.0 * math.pi) - 0.5) > np.floor(low / (2.0 * math.pi) - 0.5)
    return _Interval(
        amplitude * np.where(trough, -1.0, smallest) - _ROUNDING * amplitude,
        amplitude * np.where(crest, 1.0, largest) + _ROUNDING * amplitude,
    )


def _weight_quotient(angle: float, rho: _Interval, n0: _Interval) -> _Interval:
    """Return bounds of (sin(angle + z) - sin(angle)) / z for z = rho n0, |z| <= pi."""
    if angle == UPRIGHT:
        sinc = _sinc(rho, n0)
        return _Interval(-sinc.high, -sinc.low)
    # cos(angle + z / 2) sinc(z / 2)
    half = _Interval(
        angle + 0.5 * np.minimum(rho.low * n0.low, rho.high * n0.low),
        angle + 0.5 * np.maximum(rho.low * n0.high, rho.high * n0.high),
    )
    return _times(_direction(np.array([1.0, 0.0]), half), _sinc(_Interval(0.5 * rho.low, 0.5 * rho.high), n0))


def _sinc(rho: _Interval, n0: _Interval) -> _Interval:
    """Return bounds of sin(z)/z, which falls with |z|, for z = rho n0, |z| <= pi."""
    largest = rho.high * np.maximum(np.abs(n0.low), np.abs(n0.high))
    smallest = rho.low * np.where(n0.low * n0.high <= 0.0, 0.0, np.minimum(np.abs(n0.low), np.abs(n0.high)))
    # np.sinc(x) is sin(pi x) / (pi x).
    return _Interval(np.sinc(np.minimum(largest, math.pi) / math.pi), np.sinc(np.minimum(smallest, math.pi) / math.pi))


def _times(a: _Interval, b: _Interval) -> _Interval:
    products = np.stack([a.low * b.low, a.low * b.high, a.high * b.low, a.high * b.high])
    return _Interval(products.min(axis=0), products.max(axis=0))
