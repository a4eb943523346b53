"""Estimates of what is not measured: motor, spring and lag, and an unknown constant torque.

A stationary Kalman filter of the sampled linear model. Torques that are on their way are known, since they were sent;
a constant torque d adds to the command and is modelled as a random walk (disturbance observer):

    x[k+1] = A x[k] + B (u - u* + d),   d[k+1] = d[k] + w,   y = [theta - theta*, theta_dot] + v
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.linear.design import kalman_gain
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.angles import wrap

__all__ = ["Observer"]

Array = NDArray[np.float64]


class Observer:
    """Estimate of deviations from a fixed point: states, torques on their way, constant torque.

    Args:
        model: Linear model at the fixed point.
        period: Sampling period [s].
        p: Checked parameters: standard deviations ``angle_noise`` [rad], ``velocity_noise`` [rad/s], 0 where velocities
            are not used, and ``torque_noise`` of the unknown torque, held for a period [N m]; ``offset_noise``, how
            fast the constant torque may wander, 0 for no such torque [N m/s^0.5]; ``delay`` beyond the model's own [s].
    """

    def __init__(self, model: LinearModel, period: float, p: Mapping[str, Any]) -> None:
        sampled = discretise(model, period, p["delay"])
        n = model.A.shape[0]
        self.model = model
        self.pending = sampled.pending
        self._n = n
        self._hold = model.effort
        wide = n + (1 if p["offset_noise"] > 0.0 else 0)
        drive = discretise(replace(model, delay=0.0), period).B[:, 0]
        A = np.eye(wide)
        A[:n, :n] = sampled.A[:n, :n]
        noise = np.zeros((wide, wide))
        noise[:n, :n] = p["torque_noise"] ** 2 * np.outer(drive, drive)
        if wide > n:
            A[:n, n] = drive
            noise[n, n] = p["offset_noise"] ** 2 * period
        rows = 1 if p["velocity_noise"] == 0.0 else 2
        C = np.eye(rows, wide)
        variances = np.diag([p["angle_noise"] ** 2, p["velocity_noise"] ** 2][:rows])
        self.gain = kalman_gain(A, C, noise, variances)
        self._A = A
        self._on_their_way = sampled.A[:n, n:]
        self._B = sampled.B[:n, 0]
        self._rows = rows
        self._sent: deque[float] = deque(maxlen=self.pending)
        self.reset()

    def reset(self) -> None:
        """Forget everything: no torque is on its way."""
        self._estimate: Array | None = None
        self._sent.extend([0.0] * self.pending)

    @property
    def offset(self) -> float:
        """Estimate of the constant torque [N m]."""
        return 0.0 if self._estimate is None or self._estimate.size == self._n else float(self._estimate[-1])

    def correct(self, angle: float, velocity: float) -> Array:
        """Take a measurement and return [x; torques on their way], as the gain of a design needs it, shape (n + m,).

        Torques are relative: the deviation from the holding torque, the constant torque included.

        Args:
            angle: Measured deviation from the fixed point [rad].
            velocity: Measured velocity [rad/s]; the first one is always used.
        """
        if self._estimate is None:
            estimate = np.zeros(self._A.shape[0])
            follows = {"theta": angle, "theta_dot": velocity, "motor_angle": angle, "motor_velocity": velocity}
            estimate[: self._n] = [follows.get(name, -self._hold) for name in self.model.states]
        else:
            innovation = np.array([wrap(angle - float(self._estimate[0])), velocity - float(self._estimate[1])])
            estimate = self._estimate + self.gain.L @ innovation[: self._rows]
        self._estimate = estimate
        moving = np.array(self._sent) - self._hold + self.offset
        return np.concatenate([estimate[: self._n], moving])

    def predict(self, effort: float) -> None:
        """Move on by a period in which a torque was sent [N m]."""
        assert self._estimate is not None
        estimate = self._A @ self._estimate
        estimate[: self._n] += self._on_their_way @ (np.array(self._sent) - self._hold) + self._B * (
            effort - self._hold
        )
        self._estimate = estimate
        self._sent.append(effort)

    def carry_over(self, previous: Observer, shift: float) -> None:
        """Take over the estimate of another observer of the same plant.

        Args:
            previous: The other.
            shift: How far this fixed point lies from that one [rad].
        """
        if previous._estimate is None or previous._n != self._n:
            return
        estimate = np.zeros(self._A.shape[0])
        estimate[: self._n] = previous._estimate[: self._n]
        for index, name in enumerate(self.model.states):
            if name in {"theta", "motor_angle"}:
                estimate[index] -= shift
            elif name == "torque":
                estimate[index] += previous._hold - self._hold
        estimate[0] = wrap(estimate[0])
        if estimate.size > self._n:
            estimate[-1] = previous.offset
        self._estimate = estimate
        self._sent.extend([0.0] * self.pending + list(previous._sent))

    def describe(self) -> str:
        """Return the filter's gain."""
        rows = "; ".join(", ".join(f"{value:.6f}" for value in row) for row in self.gain.L.T)
        return f"L = [{rows}]"
