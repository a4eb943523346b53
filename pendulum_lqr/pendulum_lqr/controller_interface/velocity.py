"""Velocity, measured or estimated from positions.

Positions are in [-pi, pi) and may jump between the ends; every estimator takes differences the short way.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.linear.design import kalman_gain
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.dynamics.series_elastic import spring_deflection
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["VELOCITY_ESTIMATORS", "FilteredDifference", "KalmanVelocity", "SavitzkyGolay", "VelocityEstimator"]

_WINDOW, _ORDER = 7, 2
"""Samples to which a polynomial is fitted, and its degree."""


class VelocityEstimator(Protocol):
    """Filter from position, measured velocity and effort to velocity."""

    def reset(self) -> None:
        """Forget all samples."""

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the velocity at a sample [rad/s].

        Args:
            t: Time of the sample [s].
            position: Measured angle, wrapped [rad].
            velocity: Measured velocity [rad/s].
            effort: Torque commanded since the last sample [N m].
        """


class FilteredDifference:
    """Backward difference through a first-order low-pass, v += (1 - exp(-dt/T)) (dx/dt - v), T in [s]."""

    def __init__(self, time_constant: float) -> None:
        self.time_constant = time_constant
        self.reset()

    def reset(self) -> None:
        """Forget the last sample."""
        self._t: float | None = None
        self._position = 0.0
        self._velocity = 0.0

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the filtered difference; the measured velocity at the first sample [rad/s]."""
        if self._t is None:
            self._velocity = velocity
        else:
            dt = t - self._t
            if dt > 0.0:
                difference = wrap(position - self._position) / dt
                self._velocity += -math.expm1(-dt / self.time_constant) * (difference - self._velocity)
        self._t, self._position = t, position
        return self._velocity


class SavitzkyGolay:
    """Derivative, at the newest sample, of a polynomial fitted to the last samples; ``period`` in [s].

    Source: Savitzky and Golay, Analytical Chemistry 36(8), 1964; coefficients by scipy.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        # Imported here, because it costs 40 MB that few controllers need.
        import scipy.signal

        weights = scipy.signal.savgol_coeffs(_WINDOW, _ORDER, deriv=1, delta=period, pos=_WINDOW - 1, use="dot")
        self._weights = [float(weight) for weight in weights]
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._unwrapped: list[float] = []
        self._t = -math.inf

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the fitted velocity; the measured one until the window is full, and after a gap [rad/s]."""
        samples = self._unwrapped
        # The coefficients need equal steps: restart the window after a gap.
        if samples and not 0.5 * self.period < t - self._t < 1.5 * self.period:
            samples.clear()
        samples.append(position if not samples else samples[-1] + wrap(position - samples[-1]))
        self._t = t
        if len(samples) > _WINDOW:
            del samples[0]
        if len(samples) < _WINDOW:
            return velocity
        return sum(weight * sample for weight, sample in zip(self._weights, samples, strict=True))


class KalmanVelocity:
    """Stationary Kalman filter on the plant linearised at upright, correcting from positions only.

    The model has motor, spring, lag and torques in transit, and gravity as the true sine, so that it also holds far
    from upright.

    Args:
        plant: Plant parameters.
        period: Sampling period [s].
        position_noise: Standard deviation of a measured position [rad].
        torque_noise: Standard deviation of the unknown torque, held for a period [N m].
    """

    def __init__(
        self, plant: PlantParameters, period: float, position_noise: float = 2e-4, torque_noise: float = 0.5
    ) -> None:
        model = linearise(plant)
        n = model.A.shape[0]
        prompt = discretise(replace(model, delay=0.0), period)
        drive = prompt.B * torque_noise
        self._gain = kalman_gain(prompt.A, np.eye(1, n), drive @ drive.T, [[position_noise**2]]).L[:, 0]
        # Without gravity the step is exact for any angle; gravity acts on the link, as a sine.
        free = linearise(plant.with_values(gravity=0.0, torque_offset=0.0))
        sampled = discretise(free, period)
        self._A, self._on_their_way = sampled.A[:n, :n], sampled.A[:n, n:]
        self._B = sampled.B[:n, 0]
        self._push = discretise(LinearModel(free.A, free.E, states=free.states), period).B[:, 0]
        self._plant = plant
        self._states = model.states
        self._sent: deque[float] = deque(maxlen=sampled.pending)
        self.reset()

    def reset(self) -> None:
        """Forget the estimate and torques in transit."""
        self._estimate: NDArray[np.float64] | None = None
        self._sent.extend([0.0] * (self._sent.maxlen or 0))

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the filtered velocity; the measured one at the first sample [rad/s]."""
        plant = self._plant
        at = position if self._estimate is None else float(self._estimate[0])
        push = plant.gravity * math.sin(at - plant.angle_offset) + plant.torque_offset
        if self._estimate is None:
            self._estimate = np.array([self._first(name, position, velocity, push) for name in self._states])
            return velocity
        x = self._estimate
        x = self._A @ x + self._on_their_way @ np.array(self._sent) + self._B * effort + self._push * push
        self._sent.append(effort)
        turn = position - wrap(position - float(x[0])) - float(x[0])
        x = x + self._gain * wrap(position - float(x[0]))
        # Motor and link angles stay on the measured turn.
        x[[index for index, name in enumerate(self._states) if name in {"theta", "motor_angle"}]] += turn
        self._estimate = x
        return float(x[1])

    def _first(self, state: str, position: float, velocity: float, push: float) -> float:
        """Return a state at the first sample: no torque in the actuator, the link carried by the spring."""
        drive = self._plant.drivetrain
        if state == "motor_angle" and drive is not None:
            return position + spring_deflection(-push, drive.stiffness, drive.stiffness_hardening)
        return {"theta": position, "theta_dot": velocity, "motor_velocity": velocity}.get(state, 0.0)


VELOCITY_ESTIMATORS: dict[str, Callable[[PlantParameters, float], VelocityEstimator]] = {
    "filtered_difference": lambda plant, period: FilteredDifference(2.0 * period),
    "savitzky_golay": lambda plant, period: SavitzkyGolay(period),
    "kalman": KalmanVelocity,
}
"""Name -> maker from plant and sampling period."""
