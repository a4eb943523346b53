"""Certificates that a design made on a model stabilises a machine with a measured frequency response.

Two certificates, by Vinnicombe's theorem with the upper confidence limit of the measurement:

``gap``          nu-gap of the machine (in the task's units) below the design's margin b(P, K)
``frequency``    at each frequency, with the weights that certify most (:func:`.gap_metric.loop_distance`)

Assumptions: the machine is linear (no saturation, no dry friction at rest) and has the model's number of unstable
poles, one for an upright pendulum. Beyond the highest line it is smooth, or rolls off if lines end well below Nyquist.
Poles below the lowest line cannot be counted. For one joint the stiffness is extrapolated to 0 with its error; for
several, no loop with a mode below that line is certified if the model has such poles: an overlooked stiffness kappa
[1/s^2] changes the response at omega by some kappa / omega^2, so a hidden one is below omega^2 and harmless to faster
modes. No resonance is damped by less than :data:`.machine_response.LEAST_DAMPING`. A sharp one between two lines shows
as their deviation from a smooth plant, and a loop that it could destabilise is undecided. One hidden by the
measurement's error destabilises a loop only below the damping that the certificate reports.
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
"""Loop distance above which no practical measurement decides."""
_FASTEST = 1e-6
"""Smallest eigenvalue of a sampled loop that counts as a mode."""


@dataclass(frozen=True)
class GapProfile:
    """Distance of a machine from a model, in scaled units.

    Attributes:
        frequency: Shape (n,) [Hz].
        gap: Chordal distance, shape (n,).
        upper: Its upper confidence limit, shape (n,).
        value: nu-gap.
        value_upper: Its upper confidence limit, including frequencies beyond the highest line.
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
    """Return the gap between a machine and a model sampled at its period."""
    model = scaling.plant(model_response(plant, machine.frequency, machine.period))
    measured = scaling.plant(machine.response)
    discs = np.abs(scaling.plant(machine.radius))
    kappa = chordal_distance(model, measured)
    upper = _sum_of_angles(kappa, _disc_distance(measured, discs))
    beyond = 0.0
    if not machine.up_to_nyquist:
        # If both decrease, their distances from zero, and so from each other, are below those at the last line.
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
    """Return the sine of the sum of two angles given by sines, 1 beyond 90 degrees (triangle inequality)."""
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
    """Certificate of one design on the machine.

    Attributes:
        stable_on_model: Whether it stabilises its model, sampled at the machine's period.
        margin: b(P, K) of the model, in scaled units; 0 if unstable.
        by_gap: Whether the gap's upper limit is below the margin.
        by_frequency: Whether the loop distance is below 1 at each frequency.
        distance: Largest loop distance; < 1 is safe.
        at: Its frequency [Hz].
        worst_modulus: Smallest distance of any loop within the confidence discs from -1: the machine's modulus margin
            with 95 % confidence; 0 if a disc reaches -1.
        possible: Whether at each frequency some plant within the confidence disc has a loop distance below 1.
        unseen: Lowest frequency that a measurement needs to show what moves the model's slow poles [Hz]; 0 if it had
            it, or there are no such poles.
        resonance: Frequency near which a visible resonance could destabilise the loop [Hz]; 0 for none.
        hidden_damping: Damping ratio from which a resonance hidden by the measurement's error cannot destabilise it
            [-].
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
        """Whether the error is too large for any measurement: a tenth of it takes a hundred times as long."""
        return self.undecided and not (self.unseen or self.resonance) and self.distance >= _FAR

    @property
    def certified(self) -> bool:
        """Whether either certificate holds."""
        return (self.by_gap or self.by_frequency) and not (self.unseen or self.resonance)


def is_stable(sampled: DiscreteModel, K: ArrayLike) -> bool:
    """Return whether a static gain, shape (2,) or (2 k,), stabilises a sampled model with leading measured states."""
    return bool(np.max(np.abs(np.linalg.eigvals(closed_loop(sampled, K)))) < 1.0)


class Certifier:
    """Certifies designs made on one model for one measured machine; ``scaling`` has the gap's units."""

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
        """Return the certificate of a static gain, shape (2,) [N m/rad, N m s/rad], or (2 k,) of k joints."""
        stable = is_stable(self._sampled, K)
        found = self.feedback(np.asarray(K, dtype=np.complex128).reshape(-1, 1), stable=stable)
        if not (stable and self._has_slow_poles):
            return found
        modes = np.linalg.eigvals(closed_loop(self._sampled, K)).astype(np.complex128)
        # Modes at 0 come from a delay and are the fastest.
        slowest = float(np.min(np.abs(np.log(modes[np.abs(modes) > _FASTEST])))) / self.machine.period / (2.0 * np.pi)
        return replace(found, unseen=slowest) if slowest < self.machine.lowest else found

    def feedback(self, response: ArrayLike, *, stable: bool) -> Certificate:
        """Return the certificate of any linear controller u = -K y.

        Args:
            response: K at the machine's frequencies and period, shape (2, n), or (2, 1) for a gain.
            stable: Whether the loop with the model is stable at the machine's period.
        """
        K, machine = np.asarray(response, dtype=np.complex128), self.machine
        first, second = np.sum(K * self._model, axis=0), np.sum(K * machine.response, axis=0)
        radius = np.sum(np.abs(K) * machine.radius, axis=0)
        distance = loop_distance(first, second, radius)
        at = int(np.argmax(distance))
        plant = self._whole if K.shape[1] == 1 else self.scaling.plant(self._model)
        margin = float(np.min(pointwise_margin(plant, self.scaling.controller(K)))) if stable else 0.0
        # If the plant matters beyond the highest line, only a small loop is known to stay away from -1 there.
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
    """Return whether two loops encircle -1 equally often: the ratio of return differences does not encircle 0."""
    ratio = (1.0 + second) / (1.0 + first)
    steps = np.angle(ratio[1:] / ratio[:-1])
    if np.any(np.abs(steps) > 0.5 * np.pi) or not (ratio[0].real > 0.0 and ratio[-1].real > 0.0):
        return False
    return bool(abs(float(np.angle(ratio[0])) + float(steps.sum()) - float(np.angle(ratio[-1]))) < 1e-6)
