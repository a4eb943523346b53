"""PID on the angle alone, with a filtered derivative and back-calculation against wind-up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from pendulum_lqr.controller import BaseController
from pendulum_lqr.controllers.specs import Q, R
from pendulum_lqr.design import DesignError
from pendulum_lqr.interface import Controller
from pendulum_lqr.model import linearise
from pendulum_lqr.tuning import PidGains, pid_loop, tune_numerically, ziegler_nichols
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Pid"]


class Pid(BaseController):
    """u = -(k_p e + k_i integral of e + k_d filtered derivative of theta).

    The derivative is that of the angle, not of the error, so that a step of the set-point does not kick. Beyond the
    limit the integral is led back with the time constant sqrt(T_i T_d).

    Args:
        gains: The three gains.
        period: Sampling period [s].
        filter_time: Time constant of the derivative's filter [s].
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].

    Source: Astrom and Hagglund, Advanced PID Control, 2006, sections 3.3 to 3.5.
    """

    SUMMARY = "PID on the angle alone, tuned on the model for the cost that the LQR minimises"
    PARAMETERS = (
        ParameterSpec(
            "tuning",
            "numerical",
            "",
            "How the gains are found; manual takes kp, ki, kd as they are.",
            choices=("numerical", "ziegler_nichols", "manual"),
        ),
        ParameterSpec("kp", 0.0, "N m/rad", "Proportional gain (manual).", minimum=0.0),
        ParameterSpec("ki", 0.0, "N m/(rad s)", "Integral gain (manual).", minimum=0.0),
        ParameterSpec("kd", 0.0, "N m s/rad", "Derivative gain (manual).", minimum=0.0),
        ParameterSpec("derivative_filter", 0.02, "s", "Time constant of the derivative's low-pass.", minimum=1e-6),
        Q,
        R,
    )

    def __init__(
        self, gains: PidGains, period: float, filter_time: float, effort_limit: float, set_point: float = 0.0
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.gains = gains
        self.period = period
        self._pole = math.exp(-period / filter_time)
        self._slope = (1.0 - self._pole) / period
        integral_time = gains.kp / gains.ki if gains.ki > 0.0 else math.inf
        derivative_time = gains.kd / gains.kp if gains.kp > 0.0 else 0.0
        tracking_time = max(math.sqrt(integral_time * derivative_time), period) if gains.ki > 0.0 else math.inf
        self._tracking = period / tracking_time
        self.reset()

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Pid:
        """Return the PID tuned for the plant linearised at the set-point."""
        if p["tuning"] == "manual":
            gains = PidGains(p["kp"], p["ki"], p["kd"])
        else:
            gains = _tune(plant, period, p["set_point"], p["tuning"], p["derivative_filter"], tuple(p["q"]), p["r"])
        return cls(gains, period, p["derivative_filter"], p["effort_limit"], p["set_point"])

    def reset(self) -> None:
        """Empty integral and filter."""
        self._integral_torque = 0.0
        self._derivative = 0.0
        self._last: float | None = None

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque; the measured velocity is not used [N m]."""
        error = self.error(x[0])
        if self._last is not None:
            step = x[0] - self._last
            if not -math.pi <= step < math.pi:
                step = math.remainder(step, 2.0 * math.pi)
            self._derivative = self._pole * self._derivative + self._slope * step
        self._last = x[0]
        gains = self.gains
        integral = self._integral_torque + gains.ki * self.period * error
        wanted = -(gains.kp * error + integral + gains.kd * self._derivative)
        effort = self.clamp(wanted)
        self._integral_torque = integral + self._tracking * (wanted - effort)
        return effort

    def describe(self) -> str:
        """Return the gains."""
        gains = self.gains
        return f"kp = {gains.kp:.6g} N m/rad, ki = {gains.ki:.6g} N m/(rad s), kd = {gains.kd:.6g} N m s/rad"

    def take_over(self, previous: Controller) -> None:
        """Take over integral torque and derivative."""
        if isinstance(previous, Pid):
            self._integral_torque = previous._integral_torque
            self._derivative = previous._derivative
            self._last = previous._last


@lru_cache(maxsize=64)
def _tune(
    plant: PlantParameters,
    period: float,
    set_point: float,
    method: str,
    filter_time: float,
    q: tuple[float, ...],
    r: float,
) -> PidGains:
    model = linearise(plant, UPRIGHT + set_point)
    if method == "numerical":
        return tune_numerically(model, period, filter_time, q, r)
    gains = ziegler_nichols(model, period)
    radius = float(np.max(np.abs(np.linalg.eigvals(pid_loop(model, gains, period, filter_time)[0]))))
    if radius >= 1.0:
        raise DesignError(
            f"Ziegler-Nichols gains {gains} make the loop unstable (spectral radius {radius:.4f}) at a period of "
            f"{period} s with derivative_filter {filter_time} s; expected tuning 'numerical'"
        )
    return gains
