"""Observer of hidden states (motor, spring, lags) and unknown constant efforts, of any number of joints.

A stationary Kalman filter of the sampled linear model. Efforts in transit are known; constant efforts d add to the
commands and are modelled as random walks (disturbance observer):

    x[k+1] = A x[k] + B (u - u* + d) + E w[k],   d[k+1] = d[k] + w',   y = [q - q*, v] + noise

with w an unknown effort on every joint, at a driven one added to the command, held for a period.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.linear.design import kalman_gain
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.angles import wrap_angle
from pendulum_msgs_py.contract.joints import Coordinates, Vector

__all__ = ["Observer"]

Array = NDArray[np.float64]

_FOLLOWS = {"motor_angle": 0, "motor_velocity": 1}
"""Measured state that a hidden one follows at rest."""


class Observer:
    """Estimate of deviations from a fixed point: states, efforts in transit, constant efforts.

    Args:
        model: Linear model at the fixed point.
        coordinates: Joints, and which of them are driven.
        period: Sampling period [s].
        p: Standard deviations ``position_noise`` [rad or m], ``velocity_noise`` [rad/s or m/s], 0 to ignore velocities,
            and ``effort_noise`` of the unknown effort on every joint [N m or N]; drift ``offset_noise`` of constant
            efforts, 0 for none [N m/s^0.5]; ``delay`` in addition to the model's [s]. Without ``position_noise``
            measurements are used unfiltered, and the rest is predicted.

    Attributes:
        gain: L; None for unfiltered measurements.
    """

    def __init__(self, model: LinearModel, coordinates: Coordinates, period: float, p: Mapping[str, Any]) -> None:
        sampled = discretise(model, period, p["delay"])
        n, m = model.B.shape
        self.model, self.pending, self._coordinates = model, sampled.pending, coordinates
        self._n, self._joints = n, len(coordinates.joints)
        self._hold = np.array(model.efforts)
        self._A, self._on_their_way, self._B = sampled.A[:n, :n], sampled.A[:n, n:], sampled.B[:n]
        self._rows = 2 * self._joints
        self.gain: Array | None = None
        if p.get("position_noise"):
            self._filter(model, period, p)
        self._hold_of_all, self._none = np.tile(self._hold, self.pending), np.zeros(m)
        self._turns = tuple(joint.turns for joint in coordinates.joints)
        self._sent: deque[float] = deque(maxlen=self.pending * m)
        self.reset()

    def _filter(self, model: LinearModel, period: float, p: Mapping[str, Any]) -> None:
        n, m = model.B.shape
        driven = list(self._coordinates.driven)
        wide = n + (m if p["offset_noise"] > 0.0 else 0)
        entry = model.E.copy()
        entry[:, driven] = model.B
        unknown = discretise(replace(model, B=entry, delay=0.0), period).B
        A = np.eye(wide)
        A[:n, :n] = self._A
        noise = np.zeros((wide, wide))
        noise[:n, :n] = p["effort_noise"] ** 2 * sum(np.outer(column, column) for column in unknown.T)
        if wide > n:
            A[:n, n:] = unknown[:, driven]
            noise[n:, n:] = p["offset_noise"] ** 2 * period * np.eye(m)
        if p["velocity_noise"] == 0.0:
            self._rows = self._joints
        variances = np.repeat([p["position_noise"] ** 2, p["velocity_noise"] ** 2], self._joints)[: self._rows]
        self.gain = kalman_gain(A, np.eye(self._rows, wide), noise, np.diag(variances)).L
        self._A = A

    def reset(self) -> None:
        """Forget the estimate and efforts in transit."""
        self._estimate: Array | None = None
        self._sent.extend([0.0] * (self.pending * len(self._hold)))

    @property
    def offsets(self) -> Array:
        """Estimates of the m constant efforts [N m or N]."""
        if self._estimate is None or len(self._A) == self._n:
            return self._none
        return self._estimate[self._n :]

    def correct(self, off: Vector, velocity: Vector) -> Array:
        """Process a measurement and return [x; efforts in transit] for the gain of a design, shape (n + p m,).

        Efforts are deviations from the holding ones, including constant efforts; ``off`` those from the fixed point
        [rad or m]. The first measurement always uses velocities [rad/s or m/s].
        """
        measured = np.array([*off, *velocity])
        if self._estimate is None:
            estimate = np.zeros(len(self._A))
            estimate[: measured.size] = measured
            for index, name in enumerate(self.model.hidden, start=measured.size):
                estimate[index] = measured[_FOLLOWS[name]] if name in _FOLLOWS else -self._held_by(name)
        elif self.gain is None:
            estimate = self._estimate.copy()
            estimate[: measured.size] = measured
        else:
            innovation = measured - self._estimate[: measured.size]
            for joint, turns in enumerate(self._turns):
                if turns:
                    innovation[joint] = wrap_angle(float(innovation[joint]))
            estimate = self._estimate + self.gain @ innovation[: self._rows]
        self._estimate = estimate
        if not self.pending:
            return estimate[: self._n]
        moving = np.array(self._sent) - self._hold_of_all
        if len(self._A) > self._n:
            moving += np.tile(self.offsets, self.pending)
        return np.concatenate([estimate[: self._n], moving])

    def predict(self, efforts: Vector) -> None:
        """Predict over a period in which m efforts were sent [N m or N]."""
        assert self._estimate is not None
        estimate = self._A @ self._estimate
        change = self._B @ (np.array(efforts) - self._hold)
        if self.pending:
            change = self._on_their_way @ (np.array(self._sent) - self._hold_of_all) + change
        estimate[: self._n] += change
        # Forget a measurement beyond all bounds.
        self._estimate = estimate if math.isfinite(estimate @ estimate) else None
        self._sent.extend(efforts)

    def carry_over(self, previous: Observer) -> None:
        """Take over the estimate of another observer of the same plant about another fixed point."""
        if previous._estimate is None or previous._n != self._n:
            return
        estimate = np.zeros(len(self._A))
        estimate[: self._n] = previous._estimate[: self._n]
        here, there = self.model.position, previous.model.position
        estimate[: self._joints] = self._coordinates.deviation(
            tuple(one + was for one, was in zip(estimate[: self._joints].tolist(), there, strict=True)), here
        )
        for index, name in enumerate(self.model.hidden, start=2 * self._joints):
            if name == "motor_angle":
                estimate[index] -= here[0] - there[0]
            elif name not in _FOLLOWS:
                estimate[index] += previous._held_by(name) - self._held_by(name)
        if estimate.size > self._n:
            estimate[self._n :] = previous.offsets
        self._estimate = estimate
        self._sent.extend([0.0] * (self.pending * len(self._hold)) + list(previous._sent))

    def _held_by(self, lagged: str) -> float:
        """Return the holding effort of the actuator of a lagged-effort state [N m or N]."""
        names = self._coordinates.driven_names
        joint = lagged.removesuffix("_effort")
        return float(self._hold[names.index(joint) if joint in names else 0])
