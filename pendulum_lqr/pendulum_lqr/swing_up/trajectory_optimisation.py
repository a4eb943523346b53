"""Swing-up trajectories by direct collocation (CasADi, IPOPT)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.model import acceleration_from_upright
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["OptimisedTrajectory", "rigid_flow", "swing_up_trajectory"]

Array = NDArray[np.float64]

_SIGN_VELOCITY = 0.05
_GUESSES = (5.0, 9.0, 13.0)


@dataclass(frozen=True)
class OptimisedTrajectory:
    """Trajectory from hanging at rest to rest at the set-point.

    Attributes:
        times: Shape (n + 1,), equidistant [s].
        states: [angle from upright (not wrapped), velocity], shape (n + 1, 2) [rad, rad/s].
        efforts: Torque, linear between the nodes, shape (n + 1,) [N m].
    """

    times: Array
    states: Array
    efforts: Array

    @property
    def duration(self) -> float:
        """Time from hanging to the set-point [s]."""
        return float(self.times[-1])


def rigid_flow(plant: PlantParameters, x: Any, effort: Any) -> Any:
    """Return velocity and acceleration as a CasADi expression; dry friction with a smooth sign, with offsets."""
    return casadi.vertcat(x[1], acceleration_from_upright(plant, x[0], x[1], effort, casadi, _SIGN_VELOCITY))


@lru_cache(maxsize=16)
def swing_up_trajectory(
    plant: PlantParameters, effort_limit: float, nodes: int = 100, set_point: float = 0.0
) -> OptimisedTrajectory:
    """Return the fastest of the locally optimal swing-ups from several guesses, with a small cost of torque changes.

    Hermite-Simpson collocation with the torque linear between nodes; the guesses have different numbers of swings.
    ``effort_limit`` [N m] should leave a reserve for the feedback; ``set_point`` is the end, from upright [rad].

    Raises:
        DesignError: No guess leads there.

    Source:
        Kelly, An introduction to trajectory optimization, SIAM Review 59(4), 2017, section 4 and table 1.
    """
    opti = casadi.Opti()
    duration = opti.variable()
    X = opti.variable(2, nodes + 1)
    U = opti.variable(nodes + 1)
    h = duration / nodes

    for k in range(nodes):
        left, right = X[:, k], X[:, k + 1]
        slope_left, slope_right = rigid_flow(plant, left, U[k]), rigid_flow(plant, right, U[k + 1])
        middle = 0.5 * (left + right) + h / 8.0 * (slope_left - slope_right)
        slope_middle = rigid_flow(plant, middle, 0.5 * (U[k] + U[k + 1]))
        opti.subject_to(right == left + h / 6.0 * (slope_left + 4.0 * slope_middle + slope_right))
    opti.subject_to(opti.bounded(-effort_limit, U, effort_limit))
    # Without a command the pendulum rests where gravity balances the torque offset.
    balance = plant.torque_offset / plant.gravity if plant.gravity > 0.0 else 0.0
    start = plant.angle_offset + math.asin(max(-1.0, min(1.0, balance))) - math.pi
    opti.subject_to(X[:, 0] == casadi.DM([start, 0.0]))
    opti.subject_to(X[:, nodes] == casadi.DM([set_point, 0.0]))
    opti.subject_to(opti.bounded(0.05, duration, 60.0))
    opti.minimize(duration + 1e-3 * casadi.sumsqr(U[1:] - U[:-1]))
    opti.solver(
        "ipopt", {"expand": True, "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 600}
    )
    best: OptimisedTrajectory | None = None
    s = np.linspace(0.0, 1.0, nodes + 1)
    # Time scale of the plant: its small oscillation, or its slow decay if overdamped.
    scale = max(
        2.0 * math.pi * math.sqrt(plant.inertia / max(plant.gravity, 1e-6)),
        4.0 * plant.damping / max(effort_limit, 1e-6),
    )
    for swings in _GUESSES:
        opti.set_initial(duration, 1.6 * scale)
        opti.set_initial(X[0, :], start + (set_point - start) * s**2 * np.cos((1.0 - s) * swings))
        opti.set_initial(X[1, :], 0.0)
        opti.set_initial(U, effort_limit * np.sign(np.cos((1.0 - s) * swings)))
        try:
            solution = opti.solve()
        except RuntimeError:
            continue
        found = OptimisedTrajectory(
            np.linspace(0.0, float(solution.value(duration)), nodes + 1),
            np.asarray(solution.value(X), dtype=np.float64).T,
            np.asarray(solution.value(U), dtype=np.float64).ravel(),
        )
        if best is None or found.duration < best.duration:
            best = found
    if best is None:
        raise DesignError(
            f"no swing-up found with {effort_limit:g} N m against a gravity of {plant.gravity:g} N m; "
            "expected a larger effort_limit"
        )
    return best
