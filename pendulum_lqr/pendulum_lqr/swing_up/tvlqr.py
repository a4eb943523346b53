"""Time-varying LQR along a swing-up, and handover to the LQR about upright."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import within_limits
from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of
from pendulum_lqr.swing_up.trajectory import MechanismTrajectory
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["MechanismTvlqr", "tracking_gains", "whole_turns"]

Array = NDArray[np.float64]


def tracking_gains(
    plant: PlantParameters, states: Array, efforts: Array, period: float, q: ArrayLike, r: float, terminal: Array
) -> tuple[Array, Array]:
    """Return K (N, m, 2n) and cost matrices P (N + 1, 2n, 2n) of u = u0 - K (x - x0) along N samples.

    x0 are states (N + 1, 2n), u0 efforts (N, m) held over ``period`` [s]; q (2n,) and r weight their deviations [per
    s]; ``terminal`` is P at the end.

    Source:
        Tedrake, Underactuated Robotics, section 8.2 (finite-horizon LQR along a trajectory).
    """
    n, driven = len(plant.joints), plant.coordinates.driven
    m, p = len(driven), plant.packed
    forward = in_arithmetic(plant.mechanism.forward, cmath)

    def flow(*z: complex) -> tuple[complex, ...]:
        torque: list[complex] = [0.0] * n
        for index, joint in enumerate(driven):
            torque[joint] = z[2 * n + index]
        return (*z[n : 2 * n], *forward(z[:n], z[n : 2 * n], torque, p))

    Q, R = period * np.diag(np.asarray(q, dtype=np.float64)), period * r * np.eye(m)
    P = np.empty((len(efforts) + 1, 2 * n, 2 * n))
    K = np.empty((len(efforts), m, 2 * n))
    P[-1] = terminal
    for k in range(len(efforts) - 1, -1, -1):
        J = np.array(complex_step(flow, (*map(float, states[k]), *map(float, efforts[k]))))
        # Two terms of the exponential: the periods are short compared to the motion.
        half = np.eye(2 * n) + 0.5 * period * J[:, : 2 * n]
        A, B = np.eye(2 * n) + period * J[:, : 2 * n] @ half, period * half @ J[:, 2 * n :]
        PB = P[k + 1] @ B
        K[k] = np.linalg.solve(R + B.T @ PB, PB.T @ A)
        P[k] = Q + A.T @ P[k + 1] @ (A - B @ K[k])
        P[k] = 0.5 * (P[k] + P[k].T)
    return K, P


def whole_turns(plant: PlantParameters, x: Vector) -> Array:
    """Return the whole turns about hanging of a state [q, v], shape (2n,), on which no motion depends [rad]."""
    turns = np.array([joint.turns for joint in plant.mechanism.joints] + [False] * len(plant.joints))
    return np.where(turns, 2.0 * math.pi * np.rint(np.array(x) / (2.0 * math.pi)), 0.0)


class MechanismTvlqr(Controller):
    """u = u0(t) - K(t) (x - x0(t)) along a swing-up, then LQR; another controller where both are far.

    The trajectory starts hanging. Where the tracking cost leaves ``tube``, the LQR catches if it can, else ``recover``.

    Args:
        period: Sampling period [s].
        q: Weights of the deviation along the trajectory, shape (2n,); r that of the efforts'.
        recover: Controller from anywhere else; None for no effort.
        tube: Largest cost x' P x of a deviation from the trajectory, as a multiple of the caught region's level.

    Raises:
        ParameterError: The trajectory is for another mechanism.
    """

    def __init__(
        self,
        period: float,
        trajectory: MechanismTrajectory,
        catch: MechanismCatch,
        *,
        q: Sequence[float],
        r: float,
        recover: Controller | None = None,
        tube: float = 1.0,
    ) -> None:
        plant = catch.plant
        names = plant.coordinates.names
        m = len(plant.coordinates.driven)
        if trajectory.joints != names or trajectory.efforts.shape[1] != m:
            raise ParameterError(
                f"trajectory of {trajectory.plant!r} has the joints {', '.join(trajectory.joints)} and "
                f"{trajectory.efforts.shape[1]} motors; expected {', '.join(names)} and {m}"
            )
        super().__init__(plant.effort_limits)
        self.plant, self.period, self.catch, self.recover = plant, period, catch, recover
        count = round(trajectory.duration / period)
        times = period * np.arange(count + 1, dtype=np.float64)
        self.states, _ = trajectory.at(times)
        # A held sample does best with the effort of the middle of its interval.
        _, self.planned = trajectory.at(times[:-1] + 0.5 * period)
        self.gains, self.costs = tracking_gains(plant, self.states, self.planned, period, q, r, catch.gain.S)
        self._tube = tube * catch.region.level
        self.reset()

    def reset(self) -> None:
        """Restart, hanging."""
        self.catch.active = False
        self._following = True
        self._began: float | None = None
        self._turned = np.zeros(2 * len(self.plant.joints))
        if self.recover is not None:
            self.recover.reset()

    def followed(self, t: float, x: Vector) -> Vector | None:
        """Return the efforts that follow the trajectory; None after its end, and once it was left."""
        if self._began is None:
            # The trajectory starts on turn 0: subtract earlier turns.
            self._began, self._turned = t, whole_turns(self.plant, x)
        k = round((t - self._began) / self.period)
        if self._following and k < len(self.planned):
            error = np.array(x) - self._turned - self.states[k]
            if float(error @ self.costs[k] @ error) <= self._tube:
                return within_limits(self.planned[k] - self.gains[k] @ error, self.effort_limits)
        self._following = False
        return None

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the efforts [N m or N]."""
        x = position + velocity
        effort = self.followed(t, x)
        if effort is not None:
            return effort
        deviation = deviation_of(self.plant.coordinates, x)
        if self.catch.holds(deviation):
            return self.catch.command(deviation)
        if self.recover is None:
            return (0.0,) * len(self.effort_limits)
        return self.recover.efforts(t, position, velocity)
