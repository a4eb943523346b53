"""Stability check of a controller with its own plant at its actual rate.

The controller, with filters and estimators, closes the loop around the sampled linear model with motor, lag and delay.
Growth is refused before the loop moves a machine.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from pendulum_lqr.controller_interface.interface import Controller, unwrapped
from pendulum_lqr.linear.analysis import Feedback, delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError, Gain, output_lqr
from pendulum_lqr.linear.model import RigidPlant, linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["growth", "require_settling", "require_stable", "settles", "settling_lqr"]

_START = 1e-5
"""Initial deviation [rad]; a hundred times as much is still far from every limit."""
_WINDOW = 100
"""Samples per window, whose spread is compared with that of earlier windows."""
_WINDOWS = 100
_DEAD, _FALLEN = 0.2, 100.0 * _START
"""A spread below this share of the largest one has died out; beyond this deviation [rad] it never will."""
_STRETCH, _UNEVEN = 25, 1.02
"""Windows that are compared where motion does not die out, and how much more of them a steady one may show."""


def growth(controller: Controller, plant: RigidPlant, period: float, set_point: float = 0.0) -> float:
    """Return the growth of motion after a release: below 1 it decays, inf if it has grown a hundredfold.

    For a gain it is the spectral radius of the sampled loop, to the power of a window. Any other loop is simulated
    until its motion decays, for 10 000 samples at most.

    Args:
        controller: Any controller, reset before and after; a predictive one must feed forward the holding torque.
        plant: Plant of the loop.
        period: Sampling period [s].
        set_point: Angle from upright [rad].
    """
    model = linearise(plant, UPRIGHT + set_point)
    if (feedback := controller.feedback) is not None:
        return delayed_spectral_radius(model, feedback.K, period, summed=feedback.summed) ** _WINDOW
    sampled = discretise(model, period)
    n = model.A.shape[0]
    z = np.zeros(n + sampled.pending)
    z[0] = _START
    if "motor_angle" in model.states:
        z[model.states.index("motor_angle")] = _START
    A, B = sampled.A, sampled.B[:, 0]
    controller.reset()
    # A predictive law needs the true holding torque; any other may rest at its own first command.
    hold = model.effort if unwrapped(controller).PREDICTS else controller.command(0.0, (set_point, 0.0))
    controller.reset()
    spreads: list[float] = []
    for window in range(_WINDOWS):
        angles = np.zeros(_WINDOW)
        for k in range(_WINDOW):
            angles[k] = z[0]
            if not abs(z[0]) < _FALLEN:
                controller.reset()
                return math.inf
            x = (set_point + float(z[0]), float(z[1]))
            effort = controller.command((window * _WINDOW + k) * period, x)
            z = A @ z + B * (effort - hold)
        spreads.append(max(float(np.ptp(angles)), 1e-6 * _START))
        if window and spreads[-1] < _DEAD * max(spreads) and spreads[-1] < spreads[-2]:
            controller.reset()
            return spreads[-1] / spreads[-2]
    controller.reset()
    # Over such long stretches the phase of an oscillation hardly matters.
    return max(spreads[-_STRETCH:]) / max(spreads[-2 * _STRETCH : -_STRETCH]) / _UNEVEN


def settles(controller: Controller, plant: RigidPlant, period: float, set_point: float = 0.0) -> bool:
    """Return whether a balancing controller settles on its plant's linear model; arguments as of :func:`growth`."""
    return growth(controller, plant, period, set_point) < 1.0


def require_stable(name: str, controller: Controller, plant: RigidPlant, period: float, set_point: float = 0.0) -> None:
    """Raise DesignError if the loop of a controller with its own plant grows; ``set_point`` from upright [rad]."""
    if settles(controller, plant, period, set_point):
        return
    model = linearise(plant, UPRIGHT + set_point)
    late = f", a delay of {model.delay:g} s" if model.delay > 0.0 else ""
    hidden = f", states that are not measured ({', '.join(model.hidden)})" if model.hidden else ""
    raise DesignError(
        f"{name} makes the loop unstable with a period of {period:g} s{late}{hidden}; expected a shorter period or "
        "smaller gains (larger r, smaller bandwidth), or lqg, which reckons with delay and hidden states"
    )


def require_settling(
    name: str,
    plant: RigidPlant | PlantParameters,
    feedback: Feedback,
    period: float,
    remedy: str,
    position: Vector | None = None,
) -> None:
    """Raise DesignError if the sampled loop of a gain with the plant grows, including lags and delay.

    ``period`` in [s]; ``remedy`` is for the message; ``position`` [rad or m], None for upright.
    """
    radius = delayed_spectral_radius(linearise(plant, position), feedback.K, period, summed=feedback.summed)
    if radius >= 1.0:
        raise DesignError(
            f"{name} asked every {period:g} s does not settle on plant {getattr(plant, 'name', '')!r}: deviations grow "
            f"by {radius:.4g} a period; expected {remedy}"
        )


def settling_lqr(plant: RigidPlant | PlantParameters, q: ArrayLike, r: ArrayLike, period: float) -> Gain:
    """Return the best gain on the measured states about upright that is stable at a sampling period [s].

    Arguments as of :func:`~pendulum_lqr.linear.design.output_lqr`.

    Raises:
        DesignError: There is no such gain, or its sampled loop grows, including lags and delay.
    """
    gain = output_lqr(linearise(plant), q, r)
    require_settling("lqr", plant, Feedback(gain.K), period, "a shorter period, larger r or smaller q")
    return gain
