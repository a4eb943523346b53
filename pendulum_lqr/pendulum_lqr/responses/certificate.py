"""Which designs carry over from a model to a machine whose frequency response was measured.

Two certificates, both by Vinnicombe's theorem and both with the upper confidence limit of the measurement:

``gap``        one number for the machine (the nu-gap in the task's units) below one number for the design, b(P, K)
``frequency``  at each frequency, with the weights that certify most (:func:`.gap_metric.loop_distance`)

They presume that the machine has as many unstable poles as the model, a pendulum upright one. Poles below the lowest
line cannot be counted: of one joint the stiffness is continued to 0 with its error; of several, where the model has
such poles, no loop with a mode below that line is certified. A stiffness that was overlooked, kappa [1/s^2], moves the
response at the line omega by about kappa / omega^2, so one that no line shows is smaller than omega^2 and cannot tip a
loop whose modes are all faster.

They presume no resonance damped by less than :data:`.machine_response.LEAST_DAMPING`. A sharp one between two lines
shows at both: what they deviate from a smooth plant is read as such a resonance, and a loop that it may bring to -1 is
undecided. One that the measurement's error hides tips a loop only below the damping that each certificate names.

Both concern the linear machine, on a grid dense enough for lightly damped loops
(:mod:`pendulum_lqr.responses.machine_response` defines how it is made of measured lines). From the highest line to the
Nyquist frequency the machine is taken to be smooth, or, where lines end well below, to roll off. Neither covers
saturation, or dry friction at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.sampled_design import DiscreteModel, closed_loop, discretise
from pendulum_lqr.responses.gap_metric import (
    DEFAULT_SCALING,
    SignalScaling,
    chordal_distance,
    loop_distance,
    nu_gap,
    pointwise_margin,
)
from pendulum_lqr.responses.machine_response import LEAST_DAMPING, Machine
from pendulum_lqr.responses.sampled_response import model_response

__all__ = ["Certificate", "Certifier", "GapProfile", "compare_machine", "is_stable"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
_FAR = 10.0
"""Loop distance from which no measurement of practical length decides."""
_FASTEST = 1e-6
"""Smallest eigenvalue of a sampled loop that counts as a mode."""


@dataclass(frozen=True)
class GapProfile:
    """How far a machine is from a model, in scaled units.

    Attributes:
        frequency: Shape (n,) [Hz].
        gap: Chordal distance, shape (n,).
        upper: Its upper confidence limit, shape (n,).
        value: The nu-gap.
        value_upper: Its upper confidence limit, the frequencies beyond the highest line included.
        at: Frequency of the limit [Hz].
        winding: Whether the winding number condition holds.
        scaling: Units.
    """

    frequency: Array
    gap: Array
    upper: Array
    value: float
    value_upper: float
    at: float
    winding: bool
    scaling: SignalScaling


def compare_machine(plant: LinearModel, machine: Machine, scaling: SignalScaling = DEFAULT_SCALING) -> GapProfile:
    """Return the gap between a model, sampled as the machine is, and the machine.

    Args:
        plant: The model.
        machine: The measured machine.
        scaling: Units of outputs and torque.
    """
    model = scaling.plant(model_response(plant, machine.frequency, machine.period))
    measured = scaling.plant(machine.response)
    discs = np.abs(scaling.plant(machine.radius))
    kappa = chordal_distance(model, measured)
    upper = _sum_of_angles(kappa, _disc_distance(measured, discs))
    beyond = 0.0
    if not machine.up_to_nyquist:
        # Where both only get smaller, they differ from nothing, and so from each other, by less than at the last line.
        largest = np.linalg.norm(np.abs(measured[:, -1]) + discs[:, -1])
        angles = _size_angle(float(largest)), _size_angle(float(np.linalg.norm(model[:, -1])))
        beyond = float(_sum_of_angles(*map(np.array, angles)))
    found = nu_gap(model, measured)
    at = int(np.argmax(upper))
    limit = max(float(upper[at]), beyond)
    return GapProfile(
        machine.frequency,
        kappa,
        upper,
        found.value,
        limit if found.winding else 1.0,
        float(machine.frequency[at] if upper[at] >= beyond else machine.frequency[-1]),
        found.winding,
        scaling,
    )


def _size_angle(size: float) -> float:
    return float(size / np.sqrt(1.0 + size**2))


def _sum_of_angles(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the sine of the sum of two angles given by their sines, 1 beyond 90 degrees: the triangle inequality."""
    angle = np.arcsin(np.clip(first, 0.0, 1.0)) + np.arcsin(np.clip(second, 0.0, 1.0))
    return np.asarray(np.sin(np.minimum(angle, np.pi / 2.0)), dtype=np.float64)


def _disc_distance(centre: Complex, discs: Array) -> Array:
    """Return a bound on the chordal distance from the centre of discs to any plant within them."""
    spread = np.linalg.norm(discs, axis=0)
    size = np.linalg.norm(centre, axis=0)
    nearest = np.maximum(size - spread, 0.0)
    return np.minimum(spread / np.sqrt(1.0 + nearest**2), 1.0)


@dataclass(frozen=True)
class Certificate:
    """The certificate of one design on the machine.

    Attributes:
        stable_on_model: Whether it stabilises the model that it was designed on, sampled as the machine is.
        margin: b(P, K) of the model, in scaled units; 0 where it does not stabilise it.
        by_gap: Whether the gap's upper limit lies below the margin.
        by_frequency: Whether the loop distance lies below 1 at each frequency.
        distance: Largest loop distance; < 1 is safe.
        at: Frequency of it [Hz].
        worst_modulus: Smallest distance of any loop within the confidence discs from -1, the machine's own modulus
            margin with 95 % confidence; 0 where a disc reaches it.
        possible: Whether at each frequency some plant within the confidence disc has a loop distance below 1.
        unseen: Frequency from which a measurement would have to begin to show what moves the model's slow poles [Hz];
            0 where it began there, or no such pole matters.
        resonance: Frequency near which a resonance that the lines show may tip the loop [Hz]; 0 for none.
        hidden_damping: Damping ratio from which a resonance that the measurement's error hides cannot tip it [-].
    """

    stable_on_model: bool
    margin: float
    by_gap: bool
    by_frequency: bool
    distance: float
    at: float
    worst_modulus: float
    possible: bool = False
    unseen: float = 0.0
    resonance: float = 0.0
    hidden_damping: float = 0.0

    @property
    def undecided(self) -> bool:
        """Whether only the measurement prevents certification: a longer one may certify it."""
        return self.possible and not self.certified

    @property
    def far(self) -> bool:
        """Whether the error alone is so large that no measurement decides: ten times less takes a hundred as long."""
        return self.undecided and not (self.unseen or self.resonance) and self.distance >= _FAR

    @property
    def certified(self) -> bool:
        """Whether either certificate holds."""
        return (self.by_gap or self.by_frequency) and not (self.unseen or self.resonance)


def is_stable(sampled: DiscreteModel, K: ArrayLike) -> bool:
    """Return whether a static gain stabilises a sampled model.

    Args:
        sampled: The model; its first states are what is measured: angle and velocity, or those of k joints.
        K: Gain, shape (2,), or (2 k,).
    """
    return bool(np.max(np.abs(np.linalg.eigvals(closed_loop(sampled, K)))) < 1.0)


class Certifier:
    """Certifies designs that were made on one model, for one measured machine.

    Args:
        plant: The model.
        machine: The machine.
        scaling: Units of outputs and torque, for the gap.
    """

    def __init__(self, plant: LinearModel, machine: Machine, scaling: SignalScaling = DEFAULT_SCALING) -> None:
        self.plant = plant
        self.machine = machine
        self.scaling = scaling
        self.profile = compare_machine(plant, machine, scaling)
        self._model = model_response(plant, machine.frequency, machine.period)
        self._sampled = discretise(plant, machine.period)
        poles = np.abs(np.linalg.eigvals(plant.A))
        self._has_slow_poles = machine.response.shape[0] > 2 and bool(np.any(poles < 2.0 * np.pi * machine.lowest))
        top = 0.5 / machine.period
        # A plant of several joints may have no response at 0: a cart rolls away.
        lowest = machine.frequency[:1] if machine.response.shape[0] > 2 else np.zeros(1)
        whole = np.concatenate([lowest, np.geomspace(1e-3, top * (1.0 - 1e-9), 400)])
        self._whole = scaling.plant(model_response(plant, whole, machine.period))

    def gain(self, K: ArrayLike) -> Certificate:
        """Return the certificate of a static gain u = -K [theta, theta_dot].

        Args:
            K: Shape (2,) [N m/rad, N m s/rad], or (2 k,) for a plant of k joints.
        """
        stable = is_stable(self._sampled, K)
        found = self.feedback(np.asarray(K, dtype=np.complex128).reshape(-1, 1), stable=stable)
        if not (stable and self._has_slow_poles):
            return found
        modes = np.linalg.eigvals(closed_loop(self._sampled, K)).astype(np.complex128)
        # Modes at 0 of a delay are the fastest there are.
        slowest = float(np.min(np.abs(np.log(modes[np.abs(modes) > _FASTEST])))) / self.machine.period / (2.0 * np.pi)
        return replace(found, unseen=slowest) if slowest < self.machine.lowest else found

    def feedback(self, response: ArrayLike, *, stable: bool) -> Certificate:
        """Return the certificate of any linear controller.

        Args:
            response: u = -K y: response of the controller at the machine's frequencies and period, shape (2, n), or
                (2, 1) for a gain.
            stable: Whether the loop with the model is stable at the machine's period.
        """
        K, machine = np.asarray(response, dtype=np.complex128), self.machine
        first, second = np.sum(K * self._model, axis=0), np.sum(K * machine.response, axis=0)
        radius = np.sum(np.abs(K) * machine.radius, axis=0)
        distance = loop_distance(first, second, radius)
        at = int(np.argmax(distance))
        plant = self._whole if K.shape[1] == 1 else self.scaling.plant(self._model)
        margin = float(np.min(pointwise_margin(plant, self.scaling.controller(K)))) if stable else 0.0
        # Where much lies beyond the highest line, only a small loop is known to stay away from -1 there.
        settled = machine.up_to_nyquist or bool((np.abs(second[-1]) + radius[-1] < 1.0) and (np.abs(first[-1]) < 1.0))
        room = np.maximum(np.abs(1.0 + second) - radius, 1e-300)
        ringing = np.zeros((2, *machine.radius.shape)) if machine.ringing is None else machine.ringing
        shown, hidden = np.sum(np.abs(K) * ringing, axis=1) / room
        tips = int(np.argmax(shown))
        nearest = np.maximum(np.abs(second - first) - radius, 0.0) / np.maximum(np.abs(1.0 + first), 1e-300)
        nearest = np.minimum(nearest, loop_distance(first, second))
        by_gap = stable and self.profile.value_upper < margin
        alike = stable and settled and _same_winding(first, second)
        by_frequency = alike and bool(distance[at] < 1.0)
        return Certificate(
            stable,
            margin,
            by_gap,
            by_frequency,
            float(distance[at]),
            float(machine.frequency[at]),
            float(max(0.0, np.min(np.abs(1.0 + second) - radius))),
            stable and bool(np.max(nearest) < 1.0),
            resonance=float(machine.frequency[tips]) if (by_gap or by_frequency) and shown[tips] >= 1.0 else 0.0,
            hidden_damping=float(np.max(hidden)) * LEAST_DAMPING,
        )


def _same_winding(first: Complex, second: Complex) -> bool:
    """Return whether two loops go round -1 equally often: the ratio of their return differences does not go round 0."""
    ratio = (1.0 + second) / (1.0 + first)
    steps = np.angle(ratio[1:] / ratio[:-1])
    if np.any(np.abs(steps) > 0.5 * np.pi) or not (ratio[0].real > 0.0 and ratio[-1].real > 0.0):
        return False
    return bool(abs(float(np.angle(ratio[0])) + float(steps.sum()) - float(np.angle(ratio[-1]))) < 1e-6)
