"""Linear quadratic regulator of a plant of several joints: u = u* - K [q - q*, v] about upright."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pendulum_lqr.analysis import delayed_spectral_radius
from pendulum_lqr.design import Gain
from pendulum_lqr.interface import JointController
from pendulum_lqr.mechanism_controller import within_limits
from pendulum_lqr.mechanism_model import linearise_mechanism, mechanism_lqr
from pendulum_lqr.policy_answers import ZERO, policy_specs
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.joints import Coordinates, Vector
from pendulum_msgs_py.parameters import ParameterSpec, validate
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JOINT_CONTROLLERS", "JointLqr", "joint_parameters", "make_joint_controller"]

JOINT_CONTROLLERS = ("lqr", "tvlqr", "policy")
"""Controllers for plants of several joints."""
_FALLBACKS = (ZERO, "lqr")


class JointLqr(JointController):
    """Continuous LQR of n joints, sampled.

    Args:
        gain: Gain, K of shape (m, 2n).
        coordinates: Joints of the plant; deviations wrap for those that turn.
        effort_limits: Largest effort of each driven joint [N m or N].
        hold: m efforts that hold the plant upright.
    """

    def __init__(self, gain: Gain, coordinates: Coordinates, effort_limits: Vector, hold: Vector) -> None:
        super().__init__(effort_limits)
        self.gain = gain
        self._deviation = coordinates.deviation
        # Plain floats: indexing an array on every state costs more than the law itself.
        self._rows = tuple(tuple(float(value) for value in row) for row in gain.K)
        self._hold = hold

    def command(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts."""
        x = self._deviation(position) + velocity
        wanted = (
            hold - sum(k * value for k, value in zip(row, x, strict=True))
            for row, hold in zip(self._rows, self._hold, strict=True)
        )
        return within_limits(wanted, self.effort_limits)

    def describe(self) -> str:
        """Return gain and poles."""
        rows = "; ".join(", ".join(f"{value:.6g}" for value in row) for row in self._rows)
        poles = ", ".join(f"{pole:.4g}" for pole in self.gain.poles)
        return f"K = [{rows}], poles {poles} 1/s"


def joint_parameters(name: str, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
    """Return the specs of what a controller of a plant of several joints takes, its own weights as defaults."""
    limit = ParameterSpec(
        "effort_limit", 0.0, "N m", "Largest effort of each driven joint; 0 for the plant's own.", minimum=0.0
    )
    if name == "policy":
        catch = ParameterSpec(
            "catch",
            ZERO,
            "",
            "Who takes over near upright, in the region from which it catches: zero for nobody, or lqr.",
            choices=_FALLBACKS,
        )
        return (*policy_specs(_FALLBACKS), catch, limit)
    if name != "lqr":
        return ()
    q, r = plant.mechanism.weights
    names = plant.coordinates.names
    return (
        ParameterSpec(
            "q", list(q), "", f"Diagonal of Q: weights of {', '.join(names)}, then of their velocities.", minimum=0.0
        ),
        ParameterSpec("r", r, "", "Weight of each effort, R.", minimum=0.0, exclusive_minimum=True),
        limit,
    )


def make_joint_controller(
    name: str, plant: MechanismParameters, values: Mapping[str, Any], period: float | None = None
) -> JointController:
    """Design a controller for a plant of several joints.

    Args:
        name: One of ``JOINT_CONTROLLERS``.
        plant: The plant.
        values: Parameters of :func:`joint_parameters` by name; others at their default.
        period: Period at which states come [s]; None where it is not known yet, which tvlqr refuses.

    Raises:
        ParameterError: No such controller for several joints, a value out of domain, a design that does not exist, or
            a loop that is unstable on the linear model at this period, delay included.
    """
    if name not in JOINT_CONTROLLERS:
        raise ParameterError(
            f"{name} is for plants of one joint, and plant {plant.name!r} has {', '.join(plant.coordinates.names)}; "
            f"expected {', '.join(JOINT_CONTROLLERS[:-1])} or {JOINT_CONTROLLERS[-1]}"
        )
    p = validate(joint_parameters(name, plant), values)
    if name == "tvlqr":
        if period is None:
            raise ParameterError(
                "tvlqr follows its trajectory at the period of the states; expected it, as period:=0.002"
            )
        from pendulum_lqr.controllers.joint_swing_up import JointSwingUp

        return JointSwingUp(plant, period)
    if name == "policy":
        from pendulum_lqr.controllers.joint_policy import design_joint_policy

        fallback = None
        if p["fallback"] != ZERO:
            fallback = make_joint_controller(p["fallback"], plant, {"effort_limit": p["effort_limit"]}, period)
        return design_joint_policy(plant, p, period, fallback)
    model = linearise_mechanism(plant)
    gain = mechanism_lqr(model, p["q"], p["r"])
    limit = p["effort_limit"] or math.inf
    if period is not None:
        growth = delayed_spectral_radius(model, gain.K, period)
        if growth >= 1.0:
            raise ParameterError(
                f"{name} asked every {period:g} s does not settle on plant {plant.name!r}: deviations grow by "
                f"{growth:.3g} a period; expected a faster plant, or a smaller q"
            )
    return JointLqr(gain, plant.coordinates, tuple(min(limit, own) for own in plant.effort_limits), model.efforts)
