"""The nu-gap between two plants, and the stability margin of controllers, from frequency responses.

Plants have one input (torque) and any outputs, measured or modelled. Signals are scaled first, because a gap depends on
units.

    chordal distance     kappa = |sin| of the angle between [1; P1] and [1; P2]
    margin               rho   = |1 + K P| / (sqrt(1 + |P|^2) sqrt(1 + |K|^2))   (u = -K y)
    nu-gap               delta = max kappa over frequency, 1 if the winding number condition fails
    theorem              K that stabilises P1 stabilises P2 if delta(P1, P2) < b(P1, K) = min rho, or if the winding
                         number condition holds and kappa < rho at each frequency

Source: Vinnicombe, Frequency domain uncertainty and the graph topology, IEEE TAC 38(9), 1993, theorems 3.1 and 4.3;
Vinnicombe, Uncertainty and Feedback, Imperial College Press, 2001, sections 2.3 and 3.2.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "DEFAULT_SCALING",
    "JointScaling",
    "NuGap",
    "Scaling",
    "SignalScaling",
    "chordal_distance",
    "loop_distance",
    "nu_gap",
    "pointwise_margin",
    "winding_number",
]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class SignalScaling(ABC):
    """Units of signals: the deviations that the task permits, and the torque available for them."""

    @property
    @abstractmethod
    def outputs(self) -> Array:
        """Unit of each output, shape (outputs, 1)."""

    @property
    @abstractmethod
    def input(self) -> float:
        """Unit of the torque or force."""

    @abstractmethod
    def sentence(self) -> str:
        """Return the scaling as a sentence."""

    def plant(self, response: ArrayLike) -> Complex:
        """Return a response, shape (outputs, n), in scaled units."""
        return np.asarray(response, dtype=np.complex128) * self.input / self.outputs

    def controller(self, response: ArrayLike) -> Complex:
        """Return a feedback, shape (outputs, n) or (outputs, 1), in scaled units."""
        return np.asarray(response, dtype=np.complex128) * self.outputs / self.input

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)  # type: ignore[call-overload]


@dataclass(frozen=True, slots=True)
class Scaling(SignalScaling):
    """Scaling of a plant of one joint: angle [rad], velocity [rad/s] and torque [N m]."""

    angle: float = 0.03
    velocity: float = 3.0
    torque: float = 1.0

    def __post_init__(self) -> None:
        for name, unit in (("angle", "rad"), ("velocity", "rad/s"), ("torque", "N m")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ParameterError(f"scale of {name} is {value} {unit}; expected a finite value > 0")

    @property
    def outputs(self) -> Array:
        """Units of angle [rad] and velocity [rad/s]."""
        return np.array([[self.angle], [self.velocity]])

    @property
    def input(self) -> float:
        """Unit of the torque [N m]."""
        return self.torque

    def sentence(self) -> str:
        """Return the scaling as a sentence."""
        return (
            f"One unit is {self.angle:g} rad of angle, {self.velocity:g} rad/s of velocity and "
            f"{self.torque:g} N m of torque: the deviations that the task allows, and the torque it has for them."
        )


DEFAULT_SCALING = Scaling()


@dataclass(frozen=True, slots=True)
class JointScaling(SignalScaling):
    """Scaling of several joints, one driven: ``values`` of outputs in ``units``, ``effort`` in ``effort_unit``."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[float, ...]
    effort: float
    effort_unit: str

    @classmethod
    def of_weights(
        cls, names: Sequence[str], units: Sequence[str], q: Sequence[float], r: float, effort_unit: str
    ) -> JointScaling:
        """Return the scaling of LQR weights q > 0 [1/unit^2] and r > 0: deviations of equal cost.

        Source:
            Bryson and Ho, Applied Optimal Control, 1975, section 5.2 (q = 1 / largest deviation squared).
        """
        return cls(tuple(names), tuple(units), tuple(float(w) ** -0.5 for w in q), float(r) ** -0.5, effort_unit)

    @classmethod
    def of_plant(cls, plant: PlantParameters, names: Sequence[str]) -> JointScaling:
        """Return the scaling of a plant's own LQR weights; ``names`` are those of its positions and velocities."""
        joints = plant.coordinates.joints
        units = [joint.unit for joint in joints] + [joint.velocity_unit for joint in joints]
        return cls.of_weights(names, units, *plant.weights, plant.coordinates.drive_unit)

    @property
    def outputs(self) -> Array:
        """Unit of each output."""
        return np.array(self.values)[:, None]

    @property
    def input(self) -> float:
        """Unit of the effort."""
        return self.effort

    def sentence(self) -> str:
        """Return the scaling as a sentence."""
        parts = [f"{v:.3g} {unit} of {name}" for name, unit, v in zip(self.names, self.units, self.values, strict=True)]
        return (
            f"One unit is {', '.join(parts)} and {self.effort:.3g} {self.effort_unit} of effort: what the plant's own "
            "LQR weights count alike."
        )


@dataclass(frozen=True, slots=True)
class NuGap:
    """nu-gap of two plants.

    Attributes:
        value: 0 (same) to 1 (no controller is safe to carry over).
        at: Index of the frequency with the largest chordal distance.
        winding: Whether the winding number condition holds.
    """

    value: float
    at: int
    winding: bool


def _rows(response: ArrayLike) -> Complex:
    return np.atleast_2d(np.asarray(response, dtype=np.complex128))


def chordal_distance(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the chordal distance, 0 to 1, shape (n,), of two scaled plants (outputs, n) or (n,)."""
    a, b = _rows(first), _rows(second)
    # The wedge product of [1; a] and [1; b] gives the sine without the cancellation of sqrt(1 - cos^2).
    square = np.sum(np.abs(a - b) ** 2, axis=0)
    for i in range(a.shape[0]):
        for j in range(i + 1, a.shape[0]):
            square = square + np.abs(a[i] * b[j] - a[j] * b[i]) ** 2
    sizes = (1.0 + np.sum(np.abs(a) ** 2, axis=0)) * (1.0 + np.sum(np.abs(b) ** 2, axis=0))
    return np.asarray(np.sqrt(np.clip(square / sizes, 0.0, 1.0)), dtype=np.float64)


def pointwise_margin(plant: ArrayLike, controller: ArrayLike) -> Array:
    """Return rho at each frequency, shape (n,); its minimum is the margin b(P, K) of a stabilising K.

    Args:
        plant: Scaled response, shape (outputs, n), or (n,) for one output.
        controller: Scaled feedback, u = -K y, shape (outputs, n) or (outputs, 1).
    """
    p, k = _rows(plant), _rows(controller)
    loop = np.abs(1.0 + np.sum(k * p, axis=0))
    return np.asarray(
        loop / np.sqrt((1.0 + np.sum(np.abs(p) ** 2, axis=0)) * (1.0 + np.sum(np.abs(k) ** 2, axis=0))),
        dtype=np.float64,
    )


def winding_number(curve: ArrayLike) -> int:
    """Return how often a curve (n,) over frequency 0 to infinity (or Nyquist), with its mirror image, encircles 0.

    Counter-clockwise for growing frequency is positive. Neighbouring points must be within 90 degrees; the ends are
    joined to the real axis the short way.
    """
    values = np.asarray(curve, dtype=np.complex128)
    steps = np.angle(values[1:] / values[:-1])
    # Both ends of a real system are real: the shorter way to the axis is missing.
    low, high = (float(np.angle(value * np.sign(value.real or 1.0))) for value in (values[0], values[-1]))
    half = float(steps.sum()) + low - high
    return round(half / np.pi)


def nu_gap(first: ArrayLike, second: ArrayLike, *, unstable: tuple[int, int] = (1, 1)) -> NuGap:
    """Return the nu-gap of two plants from their scaled responses.

    Args:
        first: Shape (outputs, n) or (n,), on a grid from 0 to infinity (or to the Nyquist frequency).
        second: The other one, on the same grid.
        unstable: Number of unstable poles of each; an upright pendulum has one.
    """
    a, b = _rows(first), _rows(second)
    kappa = chordal_distance(a, b)
    at = int(np.argmax(kappa))
    inner = 1.0 + np.sum(np.conj(b) * a, axis=0)
    # The sign is that of increasing frequency: 100/(2s+1) and 100/(2s-1) are 0.02 apart, not 1.
    holds = bool(np.all(np.abs(inner) > 1e-12)) and winding_number(inner) == unstable[0] - unstable[1]
    return NuGap(float(kappa[at]) if holds else 1.0, at, holds)


def loop_distance(first: ArrayLike, second: ArrayLike, radius: ArrayLike = 0.0) -> Array:
    """Return the distance of a second loop from the first for the best weight, at each frequency (n,); < 1 is safe.

    The theorem holds for any weights. With W on the plant and 1/W on the controller, the condition is linear in |W|^2,
    so the best weight is one of two limits: additive, |L2 - L1| < |1 + L1|, or inverse, |1 - L1/L2| < |1 + L1|. No
    other scaling certifies more.

    Args:
        first: Loop K P1, shape (n,), stable.
        second: Loop K P2, shape (n,).
        radius: Radius of the confidence disc of the second loop, shape (n,); its worst loop counts.
    """
    one, two = np.asarray(first, dtype=np.complex128), np.asarray(second, dtype=np.complex128)
    r = np.broadcast_to(np.asarray(radius, dtype=np.float64), two.shape)
    room = np.maximum(np.abs(1.0 + one), 1e-300)
    additive = (np.abs(two - one) + r) / room
    size = np.abs(two) ** 2 - r**2
    outside = size > 0.0
    safe = np.where(outside, size, 1.0)
    # The inverse of a disc without 0 is a disc.
    centre, spread = np.conj(two) / safe, r / safe
    inverse = np.where(outside, (np.abs(1.0 - one * centre) + np.abs(one) * spread) / room, np.inf)
    return np.asarray(np.minimum(additive, inverse), dtype=np.float64)
