"""From recordings to equally spaced samples of excitation, torque, angle and velocity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.in_process import RunArrays
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.runs.series import Signal, unwrap_near_upright
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError

if TYPE_CHECKING:
    from pendulum_bags.runs.run_data import RunData

__all__ = ["INPUT_UNIT", "Record", "record_of_arrays", "record_of_joints", "record_of_run"]

INPUT_UNIT = "input_unit"
"""Fact on a run whose input is in volts."""

_EXACT = 1e-6
"""Largest tolerated deviation of a stamp from the raster, as a share of the period."""
_LONGEST_GAP = 5.0
"""Longest bridged hole between states, in periods."""
_SHORT_GAP = 0.05
"""Hole that is always bridged: its error in one period shows as noise [s]."""


@dataclass(frozen=True)
class Record:
    """One plant under one excitation, sampled at equal intervals.

    Attributes:
        period: Sampling period [s].
        excitation: Known torque that was added, shape (n,) [N m or N, or V].
        torque: Total torque from each sample to the next, including the excitation, shape (n,) [N m or N, or V].
        outputs: Angle [rad] and velocity [rad/s] at each sample, shape (2, n); for k joints all positions, then all
            velocities, shape (2 k, n).
        disturbance: Parameters of the excitation; empty if unknown.
        joints: Names of the k joints; none for a plant of one.
    """

    label: str
    period: float
    excitation: Array
    torque: Array
    outputs: Array
    disturbance: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    driven: int = 0

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.period * self.torque.size


def record_of_arrays(arrays: RunArrays, label: str, disturbance: Mapping[str, Any]) -> Record:
    """Return the record of a run in one process, with the parameters of its disturbance."""
    period = float(arrays.stamp_ns[1] - arrays.stamp_ns[0]) / NANOSECONDS
    outputs = np.stack([unwrap_near_upright(arrays.position)[:-1], arrays.velocity[:-1]])
    return Record(label, period, arrays.disturbance[:-1], arrays.applied, outputs, dict(disturbance))


def record_of_run(run: RunData) -> Record:
    """Return the record of a recorded plant while its disturbance acted; held torques are averaged, jitter is removed.

    A DataError if disturbance or applied torque are missing, or states for long.
    """
    return _record(run, [run])


def record_of_joints(runs: Mapping[str, RunData], driven: str) -> Record:
    """Return the record of several joints in order, of which one is driven, as :func:`record_of_run`."""
    return replace(_record(runs[driven], list(runs.values())), joints=tuple(runs), driven=list(runs).index(driven))


def _record(run: RunData, motions: Sequence[RunData]) -> Record:
    followed = run.followed if run.followed is not None and np.ptp(run.followed.value) > 0.0 else None
    excitation = run.disturbance if run.disturbance is not None else followed
    for signal, what in ((excitation, "disturbance"), (run.applied, "applied torque")):
        if signal is None:
            expected = (
                "expected columns of both (--topic disturbance=COLUMN, --topic input=COLUMN name them)"
                if run.of_file
                else "expected the topics disturbance and applied_effort, or those in volts"
            )
            raise DataError(
                f"{run.source or run.label} holds no {what} during the noise; {expected}, so that excitation and "
                "response are known"
            )
    assert excitation is not None
    assert run.applied is not None
    # A file in volts tells nothing of its motor; a bag is of a plant whose file does.
    if run.window.effort_unit not in {"N m", "N"} and (run.of_file or run.window.effort_unit != "V"):
        raise DataError(
            f"{run.source or run.label} has its input in {run.window.effort_unit}; expected N m or N: a mapping file "
            "states its unit"
        )
    t = run.window.t
    period = _nominal_period(t)
    longest = float(np.max(np.diff(t)))
    bridged = max(_LONGEST_GAP * period, _SHORT_GAP)
    if longest > bridged:
        raise DataError(
            f"{run.source or run.label} has no state for {longest * 1e3:.0f} ms; expected no hole longer than "
            f"{bridged * 1e3:.0f} ms"
        )
    stop = min(float(t[-1]), float(run.applied.t[-1]) + period)
    count = int(np.floor((stop - t[0]) / period + 1e-6))
    raster = t[0] + period * np.arange(count)
    exact = t.size >= count and bool(np.max(np.abs(t[:count] - raster)) < _EXACT * period)
    inside = np.minimum(raster, t[-1])

    def sampled(values: Array) -> Array:
        return values[:count] if exact else np.asarray(scipy.interpolate.CubicSpline(t, values)(inside))

    windows = [motion.window for motion in motions]
    outputs = np.stack(
        [*(sampled(window.position) for window in windows), *(sampled(window.velocity) for window in windows)]
    )
    disturbance = run_record(run.metadata).get("disturbance")
    return Record(
        run.label,
        period,
        _held_mean(excitation, raster, period),
        _held_mean(run.applied, raster, period),
        outputs,
        dict(disturbance) if isinstance(disturbance, Mapping) else {},
        {
            "source": run.source,
            "missed_states": run.missed_deadlines,
            **({INPUT_UNIT: "V"} if run.window.effort_unit == "V" else {}),
        },
    )


def _nominal_period(t: Array) -> float:
    """Return the period of jittering stamps: their mean step without holes, rounded to 0.1 ms if near."""
    steps = np.diff(t)
    mean = float(np.mean(steps[steps < 1.5 * np.median(steps)]))
    nominal = round(mean * 1e4) / 1e4
    return nominal if abs(nominal - mean) < 0.003 * mean else mean


def _held_mean(signal: Signal, raster: Array, period: float) -> Array:
    # The integral of a held signal is piecewise linear; it starts at the first sample.
    knots = np.concatenate([signal.t, [max(signal.t[-1], raster[-1] + period) + period]])
    integral = np.concatenate([[0.0], np.cumsum(signal.value * np.diff(knots))])
    at = np.interp(np.concatenate([raster, [raster[-1] + period]]), knots, integral)
    return np.diff(at) / period
