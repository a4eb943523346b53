"""LQR with friction compensation: dry friction is fed forward in the direction of the set-point, with a smooth sign."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.linear.analysis import delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError, Gain, output_lqr
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.equilibrium import friction_effort
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["LqrFriction", "lqr_friction_law"]

_HOLD, _K0, _K1, _FRICTION, _WIDTH = range(OWN, OWN + 5)

_RESERVE = 2.0
"""Gain margin of the steepest gain for an automatic width."""
_STEEPEST = 20.0
"""Largest factor on the angle's gain near the set-point: beyond it, noise of the angle fills the torque."""
_LARGEST = 0.5
"""Largest share of the torque limit for friction feedforward."""


def lqr_friction_law(
    _t: float, angle: float, velocity: float, _memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return the LQR's torque less that of a smooth sign, within the limit [N m], as a :data:`.law.Law`."""
    error = deviation(angle, numbers[SET_POINT])
    against = numbers[_FRICTION] * math.tanh(error / numbers[_WIDTH])
    wanted = numbers[_HOLD] - numbers[_K0] * error - numbers[_K1] * velocity - against
    return clamped(wanted, numbers[EFFORT_LIMIT])


class LqrFriction(LawController):
    """u = u* - K (x - x*) - c tanh((theta - theta*) / w), with c below the plant's friction.

    The pendulum returns against its deviation, so the sign is that of the deviation. The measured velocity's sign would
    turn noise into torque, and is 0 where friction holds. Near the set-point the compensation is a spring, c / w. The
    loop must be stable at its rate, without friction, for every spring from none to that one, so that less friction
    than identified cannot cause a limit cycle (sector condition for a static nonlinearity, by describing function).

    Attributes:
        friction: c, torque fed forward far from the set-point [N m].
        width: w, deviation over which it changes its sign [rad].

    Source:
        Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994, section 5.4 (compensation of friction, and
        limit cycles by too much of it); Khalil, Nonlinear Systems, 3rd ed., 2002, section 7.2 (describing function).
    """

    BALANCES = True
    SUMMARY = "LQR with most of the dry friction fed forward by a smooth sign: rests nearer to the set-point"
    PARAMETERS = (
        Q,
        R,
        FEEDFORWARD,
        ParameterSpec(
            "share", 0.8, "-", "Share of the plant's Coulomb friction that is fed forward.", minimum=0.0, maximum=0.95
        ),
        ParameterSpec(
            "width",
            0.0,
            "rad",
            "Deviation over which its sign changes; 0 for as little as the loop bears with a gain margin of 2.",
            minimum=0.0,
        ),
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        model = linearise(plant, UPRIGHT + p["set_point"])
        self.gain: Gain = output_lqr(model, p["q"], p["r"])
        self.friction = p["share"] * friction_effort(plant, model.theta)
        if self.friction > _LARGEST * p["effort_limit"]:
            raise DesignError(
                f"friction to compensate is {self.friction:.3g} N m, more than half of the effort_limit of "
                f"{p['effort_limit']:g} N m; expected a smaller share, or a plant with less friction"
            )
        self.width = math.inf
        if self.friction > 0.0:
            self.width = _width(model, self.gain, self.friction, period, p["width"])
        hold = model.effort if p["feedforward"] else 0.0
        numbers = (hold, *self.gain.K, self.friction, self.width)
        super().__init__(lqr_friction_law, p["effort_limit"], p["set_point"], numbers)

    def describe(self) -> str:
        """Return gain, compensation, and a hint on limit cycles."""
        text = f"K = [{self.gain.K[0]:.6f}, {self.gain.K[1]:.6f}]"
        if self.friction == 0.0:
            return f"{text}, no dry friction to compensate"
        return (
            f"{text}, {self.friction:.4g} N m of dry friction fed forward over {self.width:.3g} rad; a limit cycle "
            "means play, more delay or less friction than the plant file says: lower share or widen width"
        )


def _width(model: LinearModel, gain: Gain, friction: float, period: float, given: float) -> float:
    """Return the width of the sign, checked for stability from no compensation to the steepest [rad]."""
    stiffness = float(gain.K[0])
    if given > 0.0:
        steepest = friction / given
        if not _bears(model, gain, period, steepest):
            raise DesignError(
                f"width is {given:g} rad: near the set-point {friction:.3g} N m over it make a spring of "
                f"{steepest:.4g} N m/rad beside the gain of {stiffness:.4g} N m/rad, and the loop is unstable with a "
                f"period of {period:g} s; expected a larger width or a smaller share"
            )
        return given
    added = (_STEEPEST - 1.0) * stiffness
    while added > 1e-3 * stiffness:
        # The reserve applies to the whole gain on the angle.
        if _bears(model, gain, period, _RESERVE * (stiffness + added) - stiffness):
            return friction / added
        added *= 0.8
    raise DesignError(
        f"with a period of {period:g} s the loop bears no compensation of friction with a gain margin of {_RESERVE:g}; "
        "expected a shorter period, smaller gains (larger r), or lqr"
    )


def _bears(model: LinearModel, gain: Gain, period: float, added: float) -> bool:
    """Return whether the sampled loop is stable with every additional spring up to the given one [N m/rad]."""
    for extra in np.linspace(0.0, added, 24):
        K = np.array([gain.K[0] + extra, gain.K[1]])
        if delayed_spectral_radius(model, K, period) >= 1.0:
            return False
    return True
