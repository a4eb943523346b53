"""PID on the angle alone, with a filtered derivative and back-calculation against wind-up."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableSequence, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.controllers.specs import Q, R
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.tuning import PidGains, pid_loop, tune_numerically, ziegler_nichols
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Pid", "pid_law"]

_KP, _KI, _KD, _PERIOD, _POLE, _SLOPE, _TRACKING = range(OWN, OWN + 7)
_INTEGRAL, _DERIVATIVE, _LAST = range(3)
_NOTHING_YET = (0.0, 0.0, math.nan)


def pid_law(
    _t: float, angle: float, _velocity: float, memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return the torque of the three terms within the limit [N m], as a :data:`.law.Law`.

    Its memory has the integral's torque [N m], the filtered derivative [rad/s] and the last angle [rad].
    """
    error = deviation(angle, numbers[SET_POINT])
    if not math.isnan(memory[_LAST]):
        step = deviation(angle, memory[_LAST])
        memory[_DERIVATIVE] = numbers[_POLE] * memory[_DERIVATIVE] + numbers[_SLOPE] * step
    memory[_LAST] = angle
    integral = memory[_INTEGRAL] + numbers[_KI] * numbers[_PERIOD] * error
    wanted = -(numbers[_KP] * error + integral + numbers[_KD] * memory[_DERIVATIVE])
    effort = clamped(wanted, numbers[EFFORT_LIMIT])
    memory[_INTEGRAL] = integral + numbers[_TRACKING] * (wanted - effort)
    return effort


class Pid(LawController):
    """u = -(k_p e + k_i integral of e + k_d filtered derivative of theta).

    The derivative acts on the angle, not on the error, so that steps of the set-point do not kick. Beyond the limit,
    back-calculation unwinds the integral with the time constant sqrt(T_i T_d). Source: Astrom and Hagglund, Advanced
    PID Control, 2006, sections 3.3 to 3.5.
    """

    BALANCES = True
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

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        filter_time = p["derivative_filter"]
        if p["tuning"] == "manual":
            gains = PidGains(p["kp"], p["ki"], p["kd"])
        else:
            gains = _tune(plant, period, p["set_point"], p["tuning"], filter_time, tuple(p["q"]), p["r"])
        pole = math.exp(-period / filter_time)
        integral_time = gains.kp / gains.ki if gains.ki > 0.0 else math.inf
        derivative_time = gains.kd / gains.kp if gains.kp > 0.0 else 0.0
        tracking_time = max(math.sqrt(integral_time * derivative_time), period) if gains.ki > 0.0 else math.inf
        numbers = (gains.kp, gains.ki, gains.kd, period, pole, (1.0 - pole) / period, period / tracking_time)
        super().__init__(pid_law, p["effort_limit"], p["set_point"], numbers, _NOTHING_YET)
        self.gains = gains

    def describe(self) -> str:
        """Return the gains."""
        gains = self.gains
        return f"kp = {gains.kp:.6g} N m/rad, ki = {gains.ki:.6g} N m/(rad s), kd = {gains.kd:.6g} N m s/rad"

    def take_over(self, previous: Controller) -> None:
        """Take over integral torque and derivative."""
        if isinstance(previous, Pid):
            self.memory[:] = previous.memory


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
