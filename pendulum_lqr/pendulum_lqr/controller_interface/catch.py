"""LQR that takes over near the set-point, within the region where it is proven to hold under the torque limit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.linear.design import DesignError, Gain, continuous_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.roa import proven_level
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Catch", "CatchingController"]

_RELEASE = 2.0
_SHARE = 0.9
"""Default share of the proven level in which it takes over."""


@dataclass
class Catch:
    """LQR at the set-point with hysteresis: takes over inside x' S x <= level, releases beyond twice the proven level.

    Attributes:
        release: Level of release, larger than ``level``.
        effort_limit: [N m].
        set_point: Angle from upright [rad].
        hold: Holding torque [N m].
        active: Whether it is in charge.
    """

    gain: Gain
    level: float
    release: float
    effort_limit: float
    set_point: float
    hold: float
    active: bool = False

    def __post_init__(self) -> None:
        """Extract floats: indexing arrays on every state costs more than the law itself."""
        self._k0, self._k1 = (float(value) for value in self.gain.K)
        self._s00, self._s01, self._s11 = (float(self.gain.S[row]) for row in ((0, 0), (0, 1), (1, 1)))

    def reset(self) -> None:
        """Release."""
        self.active = False

    def holds(self, angle: float, velocity: float) -> bool:
        """Return whether the LQR is in charge at a state, and store that."""
        angle = wrap(angle - self.set_point)
        cost = self._s00 * angle * angle + 2.0 * self._s01 * angle * velocity + self._s11 * velocity * velocity
        self.active = cost <= (self.release if self.active else self.level)
        return self.active

    def command(self, angle: float, velocity: float) -> float:
        """Return the LQR's torque within the limit [N m]."""
        effort = self.hold - self._k0 * wrap(angle - self.set_point) - self._k1 * velocity
        return max(-self.effort_limit, min(self.effort_limit, effort))

    def describe(self) -> str:
        """Return gain and level."""
        reach = math.sqrt(self.level * self._s11 / (self._s00 * self._s11 - self._s01**2))
        return f"K = [{self._k0:.4f}, {self._k1:.4f}] within {reach:.3f} rad"


class CatchingController(BaseController):
    """Swings a rigid pendulum up (defined by a subclass) to where the LQR ``catch`` takes over."""

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(p["effort_limit"], p["set_point"])
        gain, level, hold = _proven(plant, tuple(p["catch_q"]), p["catch_r"], self.effort_limit, self.set_point)
        share = p.get("catch_share", _SHARE)
        self.catch = Catch(gain, share * level, _RELEASE * level, self.effort_limit, self.set_point, hold)

    def reset(self) -> None:
        """Release."""
        self.catch.reset()

    def take_over(self, previous: Controller) -> None:
        """Take over whether the LQR is in charge."""
        if isinstance(previous, type(self)):
            self.catch.active = previous.catch.active


@lru_cache(maxsize=32)
def _proven(
    plant: PlantParameters, q: tuple[float, ...], r: float, effort_limit: float, set_point: float
) -> tuple[Gain, float, float]:
    """Return gain, proven level and holding torque of an LQR under a torque limit; the proof neglects lag and delay.

    Raises:
        DesignError: The torque cannot hold the set-point, or no region around it can be proven.
    """
    prompt = plant.with_values(actuator_time_constant=0.0, transport_delay=0.0)
    model = linearise(prompt, UPRIGHT + set_point)
    gain = continuous_lqr(model, q, r)
    level = proven_level(prompt, gain, effort_limit, model.theta)
    if not level > 0.0:
        raise DesignError(
            f"no region around the set-point is proven to be caught with catch_q = {list(q)}, catch_r = {r:g} and "
            f"{effort_limit:g} N m; expected both weights > 0, nearer to the defaults"
        )
    return gain, level, model.effort
