"""LQR with an integral of the angle: no offset under a constant torque."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation, winds_up
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import Gain, output_lqr, with_integrals
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqi", "lqi_law"]

_HOLD, _K0, _K1, _KI, _PERIOD = range(OWN, OWN + 5)
_INTEGRAL = 0


def lqi_law(
    _t: float, angle: float, velocity: float, memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return u* - K [x - x*; integral] within the limit [N m]; see :data:`pendulum_lqr.controller_interface.law.Law`.

    It remembers the integral [rad s].
    """
    error = deviation(angle, numbers[SET_POINT])
    integral = memory[_INTEGRAL] + numbers[_PERIOD] * error
    wanted = numbers[_HOLD] - numbers[_K0] * error - numbers[_K1] * velocity - numbers[_KI] * integral
    effort = clamped(wanted, numbers[EFFORT_LIMIT])
    if not winds_up(-numbers[_KI] * error, wanted, effort):
        memory[_INTEGRAL] = integral
    return effort


class Lqi(LawController):
    """LQI: u = u* - K [theta - theta*, theta_dot, integral of (theta - theta*)].

    The integral does not wind up at the torque limit: :func:`~pendulum_lqr.controller_interface.law.winds_up`.
    """

    BALANCES = True
    SUMMARY = "LQR with an integral state: no offset under a constant torque"
    PARAMETERS = (
        Q,
        ParameterSpec(
            "q_integral",
            100.0,
            "1/(rad s)^2",
            "Weight of the integral of the angle.",
            minimum=0.0,
            exclusive_minimum=True,
        ),
        R,
        FEEDFORWARD,
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        model = linearise(plant, UPRIGHT + p["set_point"])
        self.gain: Gain = output_lqr(with_integrals(model), [*p["q"], p["q_integral"]], p["r"])
        self.feedback = Feedback(self.gain.K * (1.0, 1.0, period), (0,))
        hold = model.effort if p["feedforward"] else 0.0
        super().__init__(lqi_law, p["effort_limit"], p["set_point"], (hold, *self.gain.K, period), (0.0,))

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{', '.join(f'{value:.6f}' for value in self.gain.K)}]"

    def take_over(self, previous: Controller) -> None:
        """Keep the torque that the integral stands for, though the gain on it has changed."""
        if isinstance(previous, Lqi):
            self.memory[_INTEGRAL] = previous.memory[_INTEGRAL] * previous.numbers[_KI] / self.numbers[_KI]
