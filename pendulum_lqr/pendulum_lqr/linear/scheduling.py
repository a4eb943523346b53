"""Gains and feedforward scheduled over the angle of a reference, and the stability of the scheduled loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_lqr.linear.analysis import loop_transfer
from pendulum_lqr.linear.design import DesignError, output_lqr
from pendulum_lqr.linear.model import linearise, low_frequency
from pendulum_lqr.linear.reference import Motion, Reference
from pendulum_lqr.linear.sampled_design import closed_loop, discretise
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.plants.equilibrium import equilibrium_effort, friction_effort
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Schedule", "ScheduledMargins", "scheduled_margins"]

_KNOTS = 24
"""Angles of a full turn at which the Riccati equation is solved."""
_CELLS = 720
"""Cells of half a degree for linear interpolation: splines are too slow at run time."""
_FROZEN = 13
"""Angles along a reference at which the frozen loop is checked."""
_BLOCKS = 2000
_SMOOTH = 0.05
"""Share of the largest velocity over which the friction feedforward changes its sign."""


class Schedule:
    """LQR gain K(theta), and the feedforward torque of a motion.

    The torque is u(theta) + b(theta) theta' + M(theta) theta'', with the holding torque u and low-frequency M and b of
    the linear model there: exact for a rigid plant; of motor, spring and lag the terms below theta''' and theta'^2.

    Args:
        plant: Plant parameters.
        q: Diagonal of Q [1/rad^2, s^2/rad^2].
        r: R [1/(N m)^2].
        share: Share of the Coulomb friction in the feedforward.
        fastest: Largest velocity of the reference [rad/s].

    Raises:
        DesignError: An angle has no stabilising gain; the message names it.
    """

    def __init__(self, plant: PlantParameters, q: Sequence[float], r: float, share: float, fastest: float) -> None:
        self._plant = plant
        self._table: list[list[float]] = _table(plant, tuple(map(float, q)), float(r)).tolist()
        self._cell = 2.0 * math.pi / _CELLS
        self._share = share
        self._smooth = max(_SMOOTH * fastest, 1e-3)

    def gain(self, angle: float) -> tuple[float, float]:
        """Return K [N m/rad, N m s/rad] at an angle from upright [rad]."""
        k0, k1, _, _ = self._row(angle)
        return k0, k1

    def feedforward(self, motion: Motion) -> float:
        """Return the commanded torque of a motion [N m]."""
        _, _, damping, inertia = self._row(motion.angle)
        theta = UPRIGHT + motion.angle
        torque = equilibrium_effort(self._plant, theta) + damping * motion.velocity + inertia * motion.acceleration
        if self._share > 0.0:
            sign = math.tanh(motion.velocity / self._smooth)
            torque += self._share * friction_effort(self._plant, theta) * sign
        return torque

    def _row(self, angle: float) -> list[float]:
        place = (wrap(angle) + math.pi) / self._cell
        index = min(int(place), len(self._table) - 2)
        share = place - index
        return [a + share * (b - a) for a, b in zip(self._table[index], self._table[index + 1], strict=True)]


@lru_cache(maxsize=8)
def _table(plant: PlantParameters, q: tuple[float, ...], r: float) -> NDArray[np.float64]:
    """Return K_1 [N m/rad], K_2 and b [N m s/rad] and M [kg m^2] at the edges of the cells, shape (cells + 1, 4).

    A periodic spline interpolates Riccati solutions on a grid of angles. Cached, because references share them.
    """
    angles = np.linspace(-math.pi, math.pi, _KNOTS + 1)
    rows = []
    for angle in angles[:-1]:
        model = linearise(plant, UPRIGHT + float(angle))
        try:
            gain = output_lqr(model, q, r).K
        except DesignError as error:
            raise DesignError(f"at {angle:.3g} rad from upright: {error}") from error
        inertia, damping, _ = low_frequency(model)
        rows.append((*gain, damping, inertia))
    spline = scipy.interpolate.CubicSpline(angles, [*rows, rows[0]], bc_type="periodic")
    table: NDArray[np.float64] = spline(np.linspace(-math.pi, math.pi, _CELLS + 1))
    return table


@dataclass(frozen=True, slots=True)
class ScheduledMargins:
    """Stability of a scheduled loop: frozen at each angle of its reference, and along it.

    Attributes:
        angles: Angles of the frozen loops, from upright, shape (n,) [rad].
        radii: Largest |pole| of the sampled loop at each [-]; below 1.
        moduli: Smallest distance of each L(j w) from -1, including hold and plant delay [-].
        time_constant: Decay time of deviations along the moving reference [s], by the product of all sampled loops over
            a period (Floquet), which frozen loops do not show.
    """

    angles: tuple[float, ...]
    radii: tuple[float, ...]
    moduli: tuple[float, ...]
    time_constant: float

    @property
    def radius(self) -> float:
        """Largest |pole| of all [-]."""
        return max(self.radii)

    @property
    def modulus(self) -> float:
        """Smallest distance from -1 of all [-]."""
        return min(self.moduli)

    def describe(self) -> str:
        """Return a summary in one line."""
        return (
            f"frozen loops: modulus margin {self.modulus:.3g}, largest pole {self.radius:.4g}; along the reference a "
            f"deviation dies out with {self.time_constant:.3g} s"
        )


def scheduled_margins(
    plant: PlantParameters, period: float, reference: Reference, schedule: Schedule
) -> ScheduledMargins:
    """Return the margins of a scheduled loop sampled at ``period`` [s], without dry friction and torque limit.

    Raises:
        DesignError: A frozen loop, or that along the reference, is unstable.
    """
    low, high = reference.centre - reference.amplitude, reference.centre + reference.amplitude
    angles = np.linspace(low, high, _FROZEN) if high > low else np.array([low])
    loops, radii, moduli = [], [], []
    frequencies = np.logspace(-3, math.log10(math.pi / period), 400)
    for angle in map(float, angles):
        model = linearise(plant, UPRIGHT + angle)
        K = np.array(schedule.gain(angle))
        loops.append(closed_loop(discretise(model, period), K))
        radii.append(float(np.max(np.abs(np.linalg.eigvals(loops[-1])))))
        if radii[-1] >= 1.0:
            late = f", a delay of {model.delay:g} s" if model.delay > 0.0 else ""
            raise DesignError(
                f"lqr_tracking makes the loop unstable at {angle:.3g} rad from upright with a period of {period:g} s"
                f"{late}; expected a shorter period or smaller gains (larger r)"
            )
        held = replace(model, delay=model.delay + 0.5 * period)
        moduli.append(float(np.min(np.abs(1.0 + loop_transfer(held, K, frequencies)))))
    rate = _rate_along(reference, period, angles, np.array(loops))
    if rate >= 0.0:
        raise DesignError(
            f"the loop along the reference is unstable at {reference.frequency:g} Hz with a period of {period:g} s, "
            "though it is stable at rest at each angle; expected a smaller amplitude or frequency, or a longer "
            "move_time"
        )
    frozen = tuple(wrap(float(angle)) for angle in angles)
    return ScheduledMargins(frozen, tuple(radii), tuple(moduli), -1.0 / rate)


def _rate_along(reference: Reference, period: float, angles: NDArray[np.float64], loops: NDArray[np.float64]) -> float:
    """Return the largest Lyapunov exponent of the sampled loop along a period of the reference [1/s]."""
    samples = max(1, round(reference.period / period))
    repeats = math.ceil(samples / _BLOCKS)
    product = np.eye(loops.shape[1])
    exponent, count = 0.0, 0
    for k in range(0, samples, repeats):
        place = float(np.interp(reference.at(k * period).angle, angles, np.arange(len(angles))))
        index = min(int(place), max(len(angles) - 2, 0))
        following = min(index + 1, len(angles) - 1)
        share = place - index
        loop = (1.0 - share) * loops[index] + share * loops[following]
        product = np.linalg.matrix_power(loop, repeats) @ product
        count += repeats
        # Long products underflow; their logarithm does not.
        size = float(np.max(np.abs(product)))
        product, exponent = product / size, exponent + math.log(size)
    radius = float(np.max(np.abs(np.linalg.eigvals(product))))
    return (exponent + math.log(max(radius, 1e-300))) / (count * period)
