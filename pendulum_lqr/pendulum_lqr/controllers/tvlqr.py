"""Time-varying LQR along an optimised swing-up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.catch import CatchingController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.energy_swing_up import EnergySwingUp
from pendulum_lqr.controllers.specs import CATCH_Q, CATCH_R
from pendulum_lqr.linear.design import cost_matrices
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_lqr.swing_up.trajectory_optimisation import swing_up_trajectory
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Tvlqr"]

Array = NDArray[np.float64]

_LOST = 1.0
"""Weighted distance from the trajectory at which it is given up: 0.5 rad, or 2 rad/s."""
_CLOSE = 0.3
_MOST_LOSSES = 2
_ANGLE_SCALE, _VELOCITY_SCALE = 0.5, 2.0


class Tvlqr(CatchingController):
    """u = u0(t) - K(t) (x - x0(t)) along an optimised swing-up, then LQR.

    It joins the trajectory, or its mirror image for a plant without offsets, where it is close; far from both it pumps
    energy, so that a wrong start or a push does not end the swing-up.

    Attributes:
        trajectory: Swing-up.
        gains: K at each sample, shape (n, 2).
        pump: Swing-up away from the trajectories.

    Source: Tedrake, Underactuated Robotics, section 8.2 (finite-horizon LQR along a trajectory).
    """

    SUMMARY = "swing-up along a trajectory by direct collocation, tracked by time-varying LQR"
    PARAMETERS = (
        ParameterSpec(
            "q", [10.0, 1.0], "1/rad^2, s^2/rad^2", "Weights of angle and velocity along the trajectory.", minimum=0.0
        ),
        ParameterSpec("r", 1.0, "1/(N m)^2", "Weight of torque.", minimum=0.0, exclusive_minimum=True),
        ParameterSpec(
            "reserve", 0.1, "-", "Share of the torque limit that is left to the feedback.", minimum=0.0, maximum=0.9
        ),
        ParameterSpec("nodes", 100, "-", "Collocation intervals.", minimum=20, maximum=1000),
        CATCH_Q,
        CATCH_R,
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        limit, set_point, catch = self.effort_limit, self.set_point, self.catch
        # Gravity is symmetric; a torque offset, or a set-point next to the top, is not.
        alike = plant.torque_offset == 0.0 and set_point == plant.angle_offset
        self._signs = (1.0, -1.0) if alike else (1.0,)
        self._centre = plant.angle_offset
        self.trajectory = trajectory = swing_up_trajectory(plant, limit * (1.0 - p["reserve"]), p["nodes"], set_point)
        pumping = {"gain": 50.0, "energy_margin": 0.1, "catch_q": (30.0, 0.3), "catch_r": 1.0, "catch_share": 1.0}
        self.pump = EnergySwingUp(plant, period, {**p, **pumping})
        self.period = period
        samples = math.ceil(trajectory.duration / period)
        times = period * np.arange(samples + 1)
        self.states = np.column_stack(
            [np.interp(times, trajectory.times, trajectory.states[:, axis]) for axis in (0, 1)]
        )
        # A held sample does best with the torque of the middle of its interval.
        self.planned = np.interp(times + 0.5 * period, trajectory.times, trajectory.efforts)
        self.planned[times >= trajectory.duration] = catch.hold
        self.gains = _gains(plant, period, self.states, p["q"], p["r"], catch.gain.S)
        self.states[:, 0] -= self._centre
        self._scaled = self.states / np.array([_ANGLE_SCALE, _VELOCITY_SCALE])
        self.reset()

    def reset(self) -> None:
        """Forget the position on the trajectory."""
        super().reset()
        self.pump.reset()
        self._index: int | None = None
        self._joined = (0.0, 0)
        self._sign = 1.0
        self._losses = 0

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        angle, velocity = x[0] - self._centre, x[1]
        if self.catch.holds(x[0], velocity):
            self._index, self._losses = None, 0
            return self.catch.command(x[0], velocity)
        if self._index is not None:
            # By time, not by commands: a state without a command does not delay the trajectory.
            began, first = self._joined
            self._index = first + round((t - began) / self.period)
            if self._index >= len(self.planned) or self._distance(self._index, angle, velocity) > _LOST:
                self._index = None
                self._losses += 1
        # A plant that leaves the trajectory differs from the model; energy control depends less on it.
        if self._index is None and self._losses < _MOST_LOSSES:
            self._find(t, angle, velocity)
        if self._index is None:
            return self.clamp(self.pump.command(t, x))
        k = self._index
        nominal = self.states[k]
        gain = self.gains[k]
        error = wrap(self._sign * angle - float(nominal[0]))
        feedback = float(gain[0]) * error + float(gain[1]) * (self._sign * velocity - float(nominal[1]))
        return self.clamp(self._sign * (float(self.planned[k]) - feedback))

    def take_over(self, previous: Controller) -> None:
        """Take over whether the LQR is in charge; its own trajectory must be rejoined."""
        super().take_over(previous)
        if isinstance(previous, Tvlqr):
            self.pump.take_over(previous.pump)

    def describe(self) -> str:
        """Return the trajectory's length and the catch."""
        return f"trajectory of {self.trajectory.duration:.3f} s, catch {self.catch.describe()}"

    def _distance(self, index: int, angle: float, velocity: float) -> float:
        error = wrap(self._sign * angle - float(self.states[index, 0])) / _ANGLE_SCALE
        return math.hypot(error, (self._sign * velocity - float(self.states[index, 1])) / _VELOCITY_SCALE)

    def _find(self, t: float, angle: float, velocity: float) -> None:
        """Join the trajectory, or its mirror image, where it is closest, unless that is too far."""
        best = _CLOSE
        for sign in self._signs:
            error = (sign * angle - self.states[:, 0] + math.pi) % (2.0 * math.pi) - math.pi
            distance = np.hypot(error / _ANGLE_SCALE, sign * velocity / _VELOCITY_SCALE - self._scaled[:, 1])
            # The last samples are within the catch: the trajectory would be over.
            index = int(np.argmin(distance[:-1]))
            if distance[index] < best:
                best = float(distance[index])
                self._index, self._sign, self._joined = index, sign, (t, index)


def _gains(
    plant: PlantParameters, period: float, states: Array, q: Sequence[float], r: float, terminal: Array
) -> Array:
    """Return the discrete time-varying gains by the backward Riccati recursion, shape (n, 2)."""
    Q, R = cost_matrices(q, r)
    S = terminal
    prompt = plant.with_values(actuator_time_constant=0.0, transport_delay=0.0)
    gains = np.zeros((len(states), 2))
    for k in range(len(states) - 1, -1, -1):
        sampled = discretise(linearise(prompt, UPRIGHT + float(states[k, 0])), period)
        A, B = sampled.A, sampled.B
        K = (B.T @ S @ A) / float((R * period + B.T @ S @ B)[0, 0])
        S = Q * period + A.T @ S @ (A - B @ K)
        S = 0.5 * (S + S.T)
        gains[k] = K[0]
    return gains
