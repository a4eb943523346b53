"""Frequency response of a plant as a sampled controller sees it: torque held over a period, states at its ends.

Under zero-order hold P(e^{j w h}) is exact up to the Nyquist frequency, including hold (half a period of delay), the
plant's delay and aliasing. Responses measured at two rates are comparable only at one rate (:func:`brought_to`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.sampled_design import discretise

__all__ = ["brought_to", "model_response"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def model_response(model: LinearModel, frequency: ArrayLike, period: float = 0.0) -> Complex:
    """Return the response from torque to angle and velocity, shape (2, n) [rad/(N m), rad/s/(N m)].

    Args:
        model: Linear model of one input, with its delay; of k joints the shape is (2 k, n).
        frequency: Shape (n,) [Hz], up to the Nyquist frequency.
        period: Sampling period under zero-order hold [s]; 0 for the continuous plant.
    """
    omega = 2.0 * np.pi * np.atleast_1d(np.asarray(frequency, dtype=np.float64))
    if period > 0.0:
        sampled = discretise(model, period)
        A, B, points = sampled.A, sampled.B, np.exp(1j * omega * period)
        factor = np.ones_like(points)
    else:
        A, B, points = model.A, model.B, 1j * omega
        factor = np.exp(-1j * omega * model.delay)
    pencil = points[:, None, None] * np.eye(A.shape[0]) - A
    states = np.linalg.solve(pencil, np.broadcast_to(B.astype(np.complex128), (omega.size, *B.shape)))
    return np.asarray(states[:, : model.C.shape[0], 0].T * factor, dtype=np.complex128)


def brought_to(
    response: ArrayLike, model: LinearModel, frequency: ArrayLike, *, measured: float, period: float = 0.0
) -> Complex:
    """Convert a response (outputs, n), measured at a sampling period [s], to another one by a model's ratio.

    Only the change of hold and aliasing is the model's, so its error enters multiplied by that small change.
    Frequencies (n,) [Hz] must be below both Nyquist frequencies; period 0 is the continuous plant.
    """
    ratio = model_response(model, frequency, period) / model_response(model, frequency, measured)
    return np.asarray(np.asarray(response, dtype=np.complex128) * ratio, dtype=np.complex128)
