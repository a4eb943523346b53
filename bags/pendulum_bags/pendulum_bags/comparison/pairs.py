"""The two comparisons of a simulation with hardware: the thesis's, and the paired one under one disturbance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.alignment import Alignment, align_motion
from pendulum_bags.comparison.same_signal import AMPLITUDE, SharedSignal, compare_signals
from pendulum_bags.comparison.spectra import Spectra, spectra_of
from pendulum_bags.comparison.statistics import describe, kolmogorov_smirnov, rms
from pendulum_bags.runs.run_data import RunData, noise_hold_time
from pendulum_bags.runs.series import Series, shared_span
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import DataError

__all__ = ["Difference", "Pair", "distribution_tests", "interpolated_difference"]


_ONE_REFERENCE = 0.05
"""Largest distance of two references that count as one, as a share of the errors in following them."""


@dataclass(frozen=True)
class Difference:
    """Hardware minus simulation at common times ``t`` [s]: position [rad] and velocity [rad/s], shape (n,)."""

    t: Array
    position: Array
    velocity: Array
    simulation: Series
    hardware: Series

    def statistics(self) -> dict[str, dict[str, float]]:
        """Return count, mean, std, min, quartiles and max of both differences."""
        return {"position": describe(self.position), "velocity": describe(self.velocity)}


def interpolated_difference(simulation: Series, hardware: Series, *, at: str = "simulation") -> Difference:
    """Return the difference at the stamps of the simulation, or of the ``slower`` motion, by cubic splines."""
    start, stop = shared_span(simulation, hardware)
    use_simulation = at == "simulation" or simulation.period > 1.01 * hardware.period
    times = (simulation if use_simulation else hardware).t
    times = times[(times >= start) & (times <= stop)]
    a, b = simulation.interpolated(times), hardware.interpolated(times)
    return Difference(times, b.position - a.position, b.velocity - a.velocity, a, b)


@dataclass(frozen=True)
class Pair:
    """One run of simulation and hardware, compared; ``signal`` is None if the disturbances were not recorded.

    Args:
        aligned: Difference after the response delay has been taken out of the hardware.
        on_one_clock: Whether a shared signal other than a disturbance brought both to one clock.
    """

    simulation: RunData
    hardware: RunData
    signal: SharedSignal | None
    response: Alignment
    difference: Difference
    aligned: Difference
    spectra: Spectra
    on_one_clock: bool = False

    @classmethod
    def of(cls, simulation: RunData, hardware: RunData, *, on_one_clock: bool = False) -> Pair:
        """Compare two runs; a DataError if a plant did not move or fell, or the runs have too little in common."""
        for run in (simulation, hardware):
            if not np.ptp(run.window.position):
                where = f" in {run.joint}" if run.joint else ""
                while_noisy = "" if run.is_whole or run.of_file else " under the noise"
                raise DataError(
                    f"the {run.label} of {run.source} stood still{where} at {run.window.position[0]:.4g} "
                    f"{run.window.unit}{while_noisy}; expected a plant that moves: was it "
                    "armed, and free?"
                )
            held = run.joint and not run.window.slides and not run.is_whole and not run.of_file
            if held and np.ptp(run.window.position) > np.pi:
                raise DataError(
                    f"the {run.label} of {run.source} fell: {run.joint} turned by "
                    f"{np.ptp(run.window.position):.3g} rad under the noise; expected a plant that is held, since two "
                    "that tumble cannot be compared: choose a smaller noise or another design"
                )
        hardware = _turned(hardware, simulation)
        response = align_motion(simulation.window, hardware.window)
        shifted = hardware.window.shifted(response.delay)
        return cls(
            simulation,
            hardware,
            None
            if on_one_clock
            else compare_signals(
                simulation.disturbance,
                hardware.disturbance,
                min(simulation.window.period, hardware.window.period),
            ),
            response,
            interpolated_difference(simulation.window, hardware.window, at="slower"),
            interpolated_difference(simulation.window, shifted, at="slower"),
            spectra_of(simulation.window, hardware.window),
            on_one_clock,
        )

    @property
    def clock(self) -> Alignment | None:
        """Alignment of the disturbances; None where they were not recorded."""
        return None if self.signal is None or self.on_one_clock else self.signal.alignment

    @property
    def is_paired(self) -> bool:
        """Whether both had one disturbance, but for samples that a late loop skipped or repeated."""
        return self.on_one_clock or (self.signal is not None and self.signal.is_one)

    @property
    def why_not_paired(self) -> str:
        """Why they had not one disturbance; empty where they had."""
        return "no disturbance was recorded on both plants" if self.signal is None else self.signal.reason

    @property
    def unlike_noise(self) -> str:
        """How the disturbances differ in kind, so that unpaired statistics mean nothing; else empty."""
        if self.signal is None:
            return ""
        if not 1.0 / AMPLITUDE <= self.signal.amplitude <= AMPLITUDE:
            return f"the hardware's disturbance was {self.signal.amplitude:.2f} times as large as the simulation's"
        holds = [noise_hold_time(run) for run in (self.simulation, self.hardware)]
        if None not in holds and not math.isclose(holds[0] or 0.0, holds[1] or 0.0, rel_tol=0.05):
            first, second = (1e3 * (hold or 0.0) for hold in holds)
            return f"the disturbance was held for {first:.3g} ms in simulation and for {second:.3g} ms on hardware"
        return ""

    @property
    def unlike_references(self) -> str:
        """Why two moving references differ under the noise (in real time they start at other times), or ""."""
        ours, theirs = self.simulation, self.hardware
        if not ours.follows_reference and not theirs.follows_reference:
            return ""
        if ours.reference is None or theirs.reference is None or ours.tracking_error is None:
            return "a moving reference was followed, and it is not known on both sides which and since when"
        common = np.interp(theirs.window.t, ours.window.t, ours.reference)
        apart = rms(common - theirs.reference)
        errors = rms(ours.tracking_error), rms(theirs.window.position - UPRIGHT - theirs.reference)
        if apart <= _ONE_REFERENCE * min(errors):
            return ""
        return (
            f"the moving references of both sides were {apart:.2g} rad apart under one noise (rms; each begins with "
            f"its controller; the errors in following them were {errors[0]:.2g} rad in simulation and {errors[1]:.2g} "
            "rad on hardware)"
        )

    @property
    def delay(self) -> float:
        """Delay of the hardware's response, relative to the disturbance as each plant had it [s]."""
        return self.response.delay - (self.clock.delay if self.clock is not None else 0.0)

    @property
    def motions(self) -> tuple[Series, Series]:
        """Both motions during the noise, on the clock of the disturbance."""
        offset = self.clock.delay if self.clock is not None and self.is_paired else 0.0
        return self.simulation.window, self.hardware.window.shifted(offset)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of this pair for JSON."""
        return {
            **self.difference.statistics(),
            "rms_position": rms(self.difference.position),
            "rms_velocity": rms(self.difference.velocity),
            "path": rms(self.difference.position) / float(self.difference.hardware.position.std()),
            "disturbance_alignment": None if self.signal is None else self.signal.as_dict(),
            "response_alignment": self.response.as_dict(),
            "aligned": {**self.aligned.statistics(), "rms_position": rms(self.aligned.position)},
            "coherent_up_to_hz": self.spectra.coherent_up_to,
        }


def _turned(hardware: RunData, simulation: RunData) -> RunData:
    """Return the hardware's run shifted by whole turns to the simulation's: an angle is ambiguous by those."""
    if hardware.window.slides:
        return hardware
    turn = 2.0 * np.pi
    apart = float(np.median(hardware.window.position) - np.median(simulation.window.position))
    offset = turn * round(apart / turn)
    if offset == 0.0:
        return hardware
    window, whole = (replace(one, position=one.position - offset) for one in (hardware.window, hardware.whole))
    return replace(hardware, window=window, whole=whole)


def distribution_tests(simulation: Series, hardware: Series) -> dict[str, dict[str, Any]]:
    """Return Kolmogorov-Smirnov comparisons of angle and velocity with effective sample sizes, for JSON."""
    results = {}
    for name in ("position", "velocity"):
        found = kolmogorov_smirnov(getattr(simulation, name), getattr(hardware, name))
        results[name] = {**found._asdict(), "sizes": list(found.sizes)}
    return results
