"""Where the velocity comes from: measured, or estimated from positions.

Positions come in [-pi, pi) and may jump from one end to the other; every estimator takes differences the short way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from pendulum_lqr.design import discretise, kalman_gain
from pendulum_lqr.model import LinearModel, linearise
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "VELOCITY_ESTIMATORS",
    "FilteredDifference",
    "KalmanVelocity",
    "MeasuredVelocity",
    "SavitzkyGolay",
    "VelocityEstimator",
    "make_velocity_estimator",
]


class VelocityEstimator(Protocol):
    """A filter from positions (and what else there is) to velocity."""

    def reset(self) -> None:
        """Forget all past samples."""

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the velocity at a sample [rad/s].

        Args:
            t: Time of the sample [s].
            position: Measured angle, wrapped [rad].
            velocity: Measured velocity [rad/s].
            effort: Torque commanded since the last sample [N m].
        """


class MeasuredVelocity:
    """The velocity as the sensor gives it."""

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the measured velocity [rad/s]."""
        return velocity


class FilteredDifference:
    """Backward difference through a first-order low-pass, v += (1 - exp(-dt/T)) (dx/dt - v).

    Args:
        time_constant: T [s].
    """

    def __init__(self, time_constant: float) -> None:
        self.time_constant = time_constant
        self.reset()

    def reset(self) -> None:
        """Forget the last sample."""
        self._t: float | None = None
        self._position = 0.0
        self._velocity = 0.0

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the filtered difference; the first sample takes the measured velocity [rad/s]."""
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
    """Derivative, at its newest sample, of a polynomial fitted to the last samples.

    Args:
        period: Sampling period [s].
        window: Number of samples.
        order: Degree of the polynomial.

    Source: Savitzky and Golay, Analytical Chemistry 36(8), 1964; coefficients by scipy.
    """

    def __init__(self, period: float, window: int = 7, order: int = 2) -> None:
        self.period = period
        self.window = window
        # Here, because it costs every controller 40 MB that few have a use for.
        import scipy.signal

        weights = scipy.signal.savgol_coeffs(window, order, deriv=1, delta=period, pos=window - 1, use="dot")
        self._weights = [float(weight) for weight in weights]
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._unwrapped: list[float] = []
        self._t = -math.inf

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the fitted velocity; the measured one until the window is full, and after a gap [rad/s]."""
        samples = self._unwrapped
        # The coefficients hold for equal steps: after a hole in the samples the window starts anew.
        if samples and not 0.5 * self.period < t - self._t < 1.5 * self.period:
            samples.clear()
        samples.append(position if not samples else samples[-1] + wrap(position - samples[-1]))
        self._t = t
        if len(samples) > self.window:
            del samples[0]
        if len(samples) < self.window:
            return velocity
        return sum(weight * sample for weight, sample in zip(self._weights, samples, strict=True))


class KalmanVelocity:
    """Stationary Kalman filter on the model linearised at upright, correcting from positions only.

    Gravity is taken from the true sine, so that the filter also holds far from upright.

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
        sampled = discretise(model, period)
        drive = sampled.B * torque_noise
        gain = kalman_gain(sampled.A, np.array([[1.0, 0.0]]), drive @ drive.T, [[position_noise**2]])
        self._gain = (float(gain.L[0, 0]), float(gain.L[1, 0]))
        # Without gravity the step is exact for any angle; gravity joins the torque, as the sine that it is.
        free = discretise(
            LinearModel(np.array([[0.0, 1.0], [0.0, -plant.damping / plant.inertia]]), model.B), period
        )
        self._decay = (float(free.A[0, 1]), float(free.A[1, 1]))
        self._drive = (float(free.B[0, 0]), float(free.B[1, 0]))
        self._gravity = plant.gravity
        self.reset()

    def reset(self) -> None:
        """Forget the estimate."""
        self._angle: float | None = None
        self._velocity = 0.0

    def update(self, t: float, position: float, velocity: float, effort: float) -> float:
        """Return the filtered velocity; the first sample takes the measured one [rad/s]."""
        if self._angle is None:
            self._angle, self._velocity = position, velocity
            return velocity
        torque = effort + self._gravity * math.sin(self._angle)
        angle = self._angle + self._decay[0] * self._velocity + self._drive[0] * torque
        speed = self._decay[1] * self._velocity + self._drive[1] * torque
        innovation = wrap(position - angle)
        self._angle = wrap(angle + self._gain[0] * innovation)
        self._velocity = speed + self._gain[1] * innovation
        return self._velocity


VELOCITY_ESTIMATORS: dict[str, Callable[[PlantParameters, float], VelocityEstimator]] = {
    "measured": lambda plant, period: MeasuredVelocity(),
    "filtered_difference": lambda plant, period: FilteredDifference(2.0 * period),
    "savitzky_golay": lambda plant, period: SavitzkyGolay(period),
    "kalman": KalmanVelocity,
}
"""Name -> maker from plant and sampling period."""


def make_velocity_estimator(name: str, plant: PlantParameters, period: float) -> VelocityEstimator:
    """Return the estimator behind a name of ``VELOCITY_ESTIMATORS``.

    Raises:
        ParameterError: No such estimator.
    """
    if name not in VELOCITY_ESTIMATORS:
        raise ParameterError(f"velocity is {name!r}; expected one of {', '.join(VELOCITY_ESTIMATORS)}")
    return VELOCITY_ESTIMATORS[name](plant, period)
