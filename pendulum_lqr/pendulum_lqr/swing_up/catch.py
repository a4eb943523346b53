"""LQR about upright for any mechanism, and the region from which it catches: sampled, not proven."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.controller_interface.law import within_limits
from pendulum_lqr.linear.design import DesignError, Gain, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.joints import Coordinates, Vector
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["CaughtRegion", "MechanismCatch", "deviation_of", "make_mechanism_catch", "sample_caught_region"]

Array = NDArray[np.float64]

_STEP = 0.004
_LONGEST = 8.0
_FIRST = 0.05
"""Largest deviation of the first ellipsoid, along its longest joint axis [rad or m]."""
_SAMPLES = 200
"""Sampled states per level, half of them on the surface."""
_SHARE = 0.9
"""Share of the level found that is used."""


class CaughtRegion(NamedTuple):
    """States x from upright with x' S x <= level, from all ``samples`` of which the limited loop came to rest upright.

    The samples, on the surface and inside, are evidence, not proof.
    """

    level: float
    samples: int

    def describe(self) -> str:
        """Return a description."""
        return f"x'Sx <= {self.level:.4g} (sampled from {self.samples} states, not proven)"


def deviation_of(coordinates: Coordinates, x: Vector) -> Array:
    """Return [q - goal (wrapped where it turns), v] of a state [q, v], shape (2n,)."""
    n = len(coordinates.joints)
    return np.array([*coordinates.deviation(x[:n]), *x[n:]])


def sample_caught_region(plant: PlantParameters, gain: Gain) -> CaughtRegion:
    """Return the largest ellipsoid x' S x <= level from whose samples u = -K x, limited, comes to rest upright.

    The level grows until a sample is lost or hits an end stop, is bisected, and reduced to nine tenths. Results are
    cached by plant and gain, so a controller redesigned for another parameter has its region at once. Dry friction, lag
    and delay are neglected.

    Raises:
        DesignError: Not even the smallest states are caught.
    """
    return _sampled(plant, *(tuple(map(tuple, matrix.tolist())) for matrix in (gain.rows, gain.S)), tuple(gain.poles))


@lru_cache(maxsize=32)
def _sampled(plant: PlantParameters, *numbers: tuple[Any, ...]) -> CaughtRegion:
    """Return the result of :func:`sample_caught_region`, by the numbers of K, S and poles."""
    gain = Gain(*map(np.array, numbers))
    n = len(plant.joints)
    unit = _samples_of_level_1(gain, n)
    low, high = 0.0, _FIRST**2 / float(np.max(np.diag(np.linalg.inv(gain.S))[:n]))
    while _all_caught(plant, gain, np.sqrt(high) * unit, low):
        low, high = high, 4.0 * high
    if low == 0.0:
        raise DesignError(f"the LQR of {plant.name!r} catches no state near upright; expected a stable loop")
    for _ in range(4):
        middle = float(np.sqrt(low * high))
        if _all_caught(plant, gain, np.sqrt(middle) * unit, low):
            low = middle
        else:
            high = middle
    return CaughtRegion(_SHARE * low, _SAMPLES)


def _samples_of_level_1(gain: Gain, n: int) -> Array:
    """Return deviations on the surface of x' S x <= 1, and as many evenly inside, shape (2n, samples)."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((_SAMPLES, 2 * n))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    directions[_SAMPLES // 2 :] *= rng.random((_SAMPLES - _SAMPLES // 2, 1)) ** (0.5 / n)
    unit: Array = np.linalg.solve(np.linalg.cholesky(gain.S).T, directions.T)
    return unit


def _all_caught(plant: PlantParameters, gain: Gain, deviations: Array, known: float) -> bool:
    """Return whether all deviations, shape (2n, samples), come to rest, or to within a level known to be caught."""
    n, driven = len(plant.joints), plant.coordinates.driven
    forward = in_arithmetic(plant.mechanism.forward, np)
    along, p, goal = along_functions(n), plant.packed, np.array(plant.coordinates.goal)
    limits = np.array(plant.effort_limits)[:, None]
    turns = np.array([joint.turns for joint in plant.mechanism.joints])
    stops = np.array(plant.stops) - goal[:, None]
    x = deviations.copy()
    x[:n][turns] = wrap(x[:n][turns])
    slowest = -float(np.max(gain.poles.real))
    for k in range(round(min(_LONGEST, 6.0 / slowest) / _STEP)):
        u = np.clip(-gain.rows @ x, -limits, limits)
        torque = [np.zeros(x.shape[1]) for _ in range(n)]
        for index, joint in enumerate(driven):
            torque[joint] = u[index]
        q = tuple(goal[i] + x[i] for i in range(n))
        q, v = rk4_joints(forward, along, q, tuple(x[n:]), torque, torque, torque, _STEP, p)
        x = np.array([*(q[i] - goal[i] for i in range(n)), *v])
        if not (np.all(x[:n] >= stops[:, :1]) and np.all(x[:n] <= stops[:, 1:])):
            return False
        if k % 25 == 0:
            # A fallen state is lost; unbounded growth ends the trial early.
            if not float(np.max(np.abs(x))) < 50.0:
                return False
            if np.all(_costs(gain, x) <= known):
                return True
    return bool(np.all(_costs(gain, x) <= 0.2 * _costs(gain, deviations)))


def _costs(gain: Gain, deviations: Array) -> Array:
    """Return x' S x of each column."""
    costs: Array = np.sum(deviations * (gain.S @ deviations), axis=0)
    return costs


@dataclass
class MechanismCatch:
    """u = -K x within a region, with hysteresis: it releases at ``leave`` times the region's level."""

    plant: PlantParameters
    gain: Gain
    region: CaughtRegion
    leave: float = 2.0
    active: bool = False

    @property
    def terminal(self) -> Array:
        """S scaled to trace 4: the terminal cost of a plan, independent of the LQR's weights."""
        S: Array = self.gain.S * (4.0 / float(np.trace(self.gain.S)))
        return S

    def share(self, deviation: Array) -> float:
        """Return x' S x of a deviation from upright as a multiple of the region's level: at most 1 within."""
        return float(deviation @ self.gain.S @ deviation) / self.region.level

    def holds(self, deviation: Array) -> bool:
        """Return whether it is in charge of a deviation from upright; may take over or release."""
        self.active = self.share(deviation) <= (self.leave if self.active else 1.0)
        return self.active

    def command(self, deviation: Array) -> Vector:
        """Return the limited efforts [N m or N]."""
        return within_limits(-self.gain.rows @ deviation, self.plant.effort_limits)


def make_mechanism_catch(
    plant: PlantParameters, q: ArrayLike, r: ArrayLike, limits: Vector | None = None
) -> MechanismCatch:
    """Return the LQR of a plant about upright, weights q (2n,) and r, with its sampled region (a second or so).

    ``limits`` of the driven joints below the plant's shrink the region [N m or N].
    """
    if limits is not None:
        allowed = zip(plant.coordinates.driven_names, limits, plant.effort_limits, strict=True)
        plant = plant.with_values({f"{joint}.effort_limit": min(limit, own) for joint, limit, own in allowed})
    gain = output_lqr(linearise(plant), q, r)
    return MechanismCatch(plant, gain, sample_caught_region(plant, gain))
