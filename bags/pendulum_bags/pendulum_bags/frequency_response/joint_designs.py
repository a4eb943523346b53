"""Designs of a plant of several joints to be certified: LQR weights or gains, as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.frequency_response.designs import DesignResult
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.certificate import Certifier
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointDesign", "certify_joint_designs", "joint_designs"]

_NUMBERS = r"[-+0-9.eE]+(?:,[-+0-9.eE]+)*"
_WEIGHTS = re.compile(rf"q=({_NUMBERS})(?:[ ;]+r=({_NUMBERS}))?")
_GAIN = re.compile(rf"k=({_NUMBERS})")
_OTHER_COSTS = (1.0, 0.1, 10.0, 100.0)
"""Costs of the effort of the default designs, in addition to that of the plant's own LQR."""


@dataclass(frozen=True)
class JointDesign:
    """A static gain for a plant of several joints.

    Attributes:
        name: As in tables.
        text: As it was given.
        K: Gain on positions and velocities, shape (2 k,).
        weights: q and r of an LQR; None for a gain.
    """

    name: str
    text: str
    K: NDArray[np.float64]
    weights: tuple[tuple[float, ...], float] | None = None


def joint_designs(texts: Sequence[str], plant: MechanismParameters, model: LinearModel) -> list[JointDesign]:
    """Return the designs that texts stand for, made on a plant of several joints, one of them driven.

    Args:
        texts: ``q=10,100,1,1 r=0.1`` for LQR, positions before velocities, or ``k=...`` for a gain; none for the
            plant's own LQR and three with another cost of the effort.
        plant: The plant.
        model: Its linear model.

    Raises:
        ParameterError: A text is no design of this plant.
    """
    q, r = plant.mechanism.weights
    own = ",".join(f"{weight:g}" for weight in q)
    asked = list(texts) or [f"q={own} r={r * share:g}" for share in _OTHER_COSTS]
    return [_one(text, r, model) for text in map(str.strip, asked)]


def certify_joint_designs(texts: Sequence[str], plant: MechanismParameters, certifier: Certifier) -> list[DesignResult]:
    """Return the certificates of designs; arguments and errors as of :func:`joint_designs`.

    Args:
        texts: The designs.
        plant: The plant.
        certifier: Of its linear model and the measured machine.
    """
    return [
        DesignResult(one.name, tuple(map(float, one.K)), certifier.gain(one.K), text=one.text)
        for one in joint_designs(texts, plant, certifier.plant)
    ]


def _one(text: str, own_cost: float, model: LinearModel) -> JointDesign:
    size = model.C.shape[0]
    if match := _WEIGHTS.fullmatch(text):
        weights, (cost, *more) = _numbers(match[1], text), _numbers(match[2] or f"{own_cost}", text)
        if len(weights) == size and not more:
            K = np.asarray(output_lqr(model, weights, cost).K, dtype=np.float64)
            name = f"LQR q=({', '.join(f'{value:g}' for value in weights)}) r={cost:g}"
            return JointDesign(name, text, K, (tuple(weights), cost))
    elif match := _GAIN.fullmatch(text):
        gain = _numbers(match[1], text)
        if len(gain) == size:
            return JointDesign(f"K=({', '.join(f'{value:g}' for value in gain)})", text, np.array(gain))
    raise ParameterError(
        f"design is {text!r}; expected 'q=... r=...' or 'k=...' with {size} numbers for q or k, for "
        f"{', '.join(model.measured)}, and one for r"
    )


def _numbers(text: str, whole: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise ParameterError(f"design is {whole!r}; {text!r} are not all numbers") from error
