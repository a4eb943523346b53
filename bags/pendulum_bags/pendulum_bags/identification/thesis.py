"""The thesis's method: two linear regressions without intercept, with their full tables.

Experiment 1: effort = b theta' + M theta'' on a flat pendulum moved by hand, acceleration by finite differences of
velocity. Experiment 2: mean effort over static holds = G sin(theta), approached from both sides. Coefficients are
averaged over trials. Source: thesis "Control of a Pendulum System: From Simulation to Reality", section 4.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile, student_tail
from pendulum_bags.runs.correlation import effective_size
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.errors import DataError

__all__ = [
    "RECORD_SKEW",
    "Regression",
    "StaticHold",
    "ThesisResult",
    "fit_gravity",
    "fit_inertia_damping",
    "static_holds",
    "trial_part",
]


RECORD_SKEW = 0.5e-3
"""Time between two quantities of one record of an actuator: half a cycle of its firmware, which runs at 1 kHz [s]."""

_CORRELATED = 1.2
"""Inflation of an error from which it is told [-]."""
_STILL, _SHORTEST_HOLD = 0.02, 0.4
"""Without events: speed below which a joint stands still [rad/s], and how long a hold is at least [s]."""
_HOLD_EVENTS = ("static", "hold")
_TRIAL_EVENTS = (Event.TRIAL_START, Event.TRIAL_END)


@dataclass(frozen=True)
class Regression:
    """One ordinary least-squares fit without intercept.

    Args:
        trial: Name of the recording.
        names: Coefficients.
        values, errors, t, p: Per coefficient, shape (k,); errors allow for residuals that are correlated in time.
        intervals: 95 % intervals, shape (k, 2), with as many degrees of freedom as there are independent samples.
        inflation: By how much these errors exceed those of independent residuals, shape (k,).
        r_squared: Uncentred, as there is no intercept.
        regressors, response: The data, shape (n, k) and (n,).
    """

    trial: str
    names: tuple[str, ...]
    values: Array
    errors: Array
    t: Array
    p: Array
    intervals: Array
    inflation: Array
    r_squared: float
    regressors: Array
    response: Array

    @property
    def summary(self) -> str:
        """The full table as statsmodels prints it, for independent residuals: it takes longer than all else."""
        with warnings.catch_warnings():
            # The table of few points says so itself, by a test of normality that has no value.
            warnings.simplefilter("ignore")
            return str(_fitted(self.regressors, self.response).summary(yname="effort", xname=list(self.names)))


@dataclass(frozen=True)
class StaticHold:
    """Mean over one hold: angle [rad], effort [N m], times [s], and whether it was reached going up."""

    position: float
    effort: float
    start: float
    stop: float
    upward: bool


@dataclass(frozen=True)
class ThesisResult:
    """Regressions of all trials and their average.

    Args:
        kind: ``inertia_damping`` or ``gravity``.
        trials: One regression per recording.
        average: Mean coefficient by name, sign made positive.
        intervals: 95 % interval of the mean by name: over trials, or that of the regression for a single trial.
        sign: -1 where the actuator reports the torque of the environment.
        hysteresis: For gravity: mean of effort going up minus coming down [N m], else 0.
        sentences: What to know before believing it.
    """

    kind: str
    trials: tuple[Regression, ...]
    average: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    sign: int
    hysteresis: float
    sentences: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain JSON values."""
        return {
            "method": "thesis",
            "kind": self.kind,
            "average": self.average,
            "intervals": {name: list(ends) for name, ends in self.intervals.items()},
            "sign": self.sign,
            "hysteresis": self.hysteresis,
            "trials": [
                {
                    "trial": r.trial,
                    "coefficients": dict(zip(r.names, r.values.tolist(), strict=True)),
                    "standard_errors": dict(zip(r.names, r.errors.tolist(), strict=True)),
                    "t": dict(zip(r.names, r.t.tolist(), strict=True)),
                    "p": dict(zip(r.names, r.p.tolist(), strict=True)),
                    "intervals": dict(zip(r.names, r.intervals.tolist(), strict=True)),
                    "inflation": dict(zip(r.names, r.inflation.tolist(), strict=True)),
                    "r_squared": r.r_squared,
                }
                for r in self.trials
            ],
            "sentences": list(self.sentences),
        }


def regress(trial: str, names: Sequence[str], regressors: Array, response: Array) -> Regression:
    """Fit response (n,) = regressors (n, k) @ coefficients by ordinary least squares, without intercept.

    What the two terms leave out, such as hysteresis, is as slow as the motion: thousands of its samples, in the order
    of time, are a few independent ones, and errors of independent residuals would be several times too small.
    """
    if len(response) <= len(names):
        raise DataError(f"{trial} has {len(response)} points for {len(names)} coefficients; expected more")
    table = _fitted(regressors, response)
    independent = np.array([_independent(regressors, np.asarray(table.resid), i) for i in range(len(names))])
    # The fit takes its share of few independent samples too: their residuals are smaller than the errors were.
    inflation = np.sqrt((len(response) - len(names)) / np.maximum(independent - len(names), 1.0))
    errors = inflation * np.asarray(table.bse)
    freedom = np.maximum(independent - len(names), 1.0)
    values = np.asarray(table.params)
    t = values / np.maximum(errors, 1e-300)
    half = student_quantile(0.975, freedom) * errors
    return Regression(
        trial,
        tuple(names),
        values,
        errors,
        t,
        2.0 * student_tail(np.abs(t), freedom),
        np.stack((values - half, values + half), axis=1),
        inflation,
        float(table.rsquared),
        regressors,
        response,
    )


def _fitted(regressors: Array, response: Array) -> Any:
    # This alone takes a second to import, all of statsmodels half as long again: only those who ask for tables wait.
    from statsmodels.regression.linear_model import OLS

    return OLS(response, regressors).fit()


def _independent(regressors: Array, residual: Array, index: int) -> float:
    """Return how many independent samples determine a coefficient: of its regressor less the others, and residuals."""
    others = np.delete(regressors, index, axis=1)
    own = regressors[:, index]
    if others.shape[1]:
        own = own - others @ np.linalg.lstsq(others, own, rcond=None)[0]
    return effective_size(own, residual)


def fit_inertia_damping(recordings: Sequence[Recording], *, skew: float | None = None) -> ThesisResult:
    """Regress measured effort on velocity and acceleration, trial by trial (experiment 1).

    The interval of the inertia combines the scatter of the trials with the unknown time between the samples of
    velocity and effort, taken as uniformly distributed (ISO/IEC Guide 98-3, type B): up to ``skew`` [s], by default
    that of one actuator record (``RECORD_SKEW``) for a bag, and half a sampling period for other files.

    Raises:
        DataError: where velocity or effort is missing.
    """
    if skew is not None and not 0.0 <= skew < 1.0:
        raise DataError(f"skew is {skew} s; expected at least 0 and less than 1 s")
    trials, noisy = [], []
    for recording in map(trial_part, recordings):
        _require_effort(recording)
        if recording.velocity is None:
            raise DataError(f"{recording.name} has no velocity; the regression of experiment 1 needs it")
        acceleration = np.gradient(recording.velocity, recording.time)
        regressors = np.stack((recording.velocity, acceleration), axis=1)
        effort = np.interp(recording.time, recording.input_stamps, recording.input)
        trials.append(regress(recording.name, ("damping", "inertia"), regressors, effort))
        noisy.append(_noise_share(recording.velocity, acceleration, recording.period))
    average, intervals, sign = _average(trials)
    # Velocity and effort of one stamp are not taken at one instant: a shift tau turns b theta' into
    # b theta' + b tau theta'', which is an inertia. No regression of such samples can tell the two apart.
    shift = max(_skew(recording) for recording in recordings) if skew is None else skew
    scatter = 0.5 * (intervals["inertia"][1] - intervals["inertia"][0])
    half = float(np.hypot(scatter, 1.96 / np.sqrt(3.0) * shift * average["damping"]))
    low, high = average["inertia"] - half, average["inertia"] + half
    intervals["inertia"] = (low, high)
    share = np.mean([_share(r) for r in trials])
    said = [
        (
            f"The inertial torque is {100 * share:.1f} % of the viscous one (rms): inertia is determined to "
            f"{low:.3g} to {high:.3g} kg m^2 only, damping to {intervals['damping'][0]:.4g} to "
            f"{intervals['damping'][1]:.4g} N m s/rad."
        ),
        (
            f"A shift of 1 ms between the samples of velocity and effort is {1e-3 * average['damping']:.3g} kg m^2 of "
            f"inertia, and nothing in these recordings tells the two apart: the interval allows for "
            f"{1e3 * shift:.3g} ms (--skew) and for the scatter of the trials, {scatter:.2g} kg m^2 either way. "
            "A velocity that the actuator filters lags by more."
        ),
    ]
    said += _correlated(trials)
    if low <= 0.0:
        said.append("The data are compatible with no inertia at all: this experiment cannot determine it.")
    if sign < 0:
        said.append(
            "The coefficients were negative: the actuator reports the torque of the environment; signs are turned."
        )
    said.append(
        f"Noise of the velocity is {100 * np.mean(noisy):.2g} % of the power of its finite differences, and makes the "
        "inertia too small by as much."
    )
    return ThesisResult("inertia_damping", tuple(trials), average, intervals, sign, 0.0, tuple(said))


def _skew(recording: Recording) -> float:
    same_record = recording.input_time is None and "topic" in recording.meta
    return RECORD_SKEW if same_record else 0.5 * recording.period


def _noise_share(velocity: Array, acceleration: Array, period: float) -> float:
    # Second differences of a motion that is smooth at the sampling rate are noise: six times its variance.
    noise = np.mean(np.diff(velocity, 2) ** 2) / 6.0
    return float(min(1.0, noise / (2.0 * period**2) / max(float(np.mean(acceleration**2)), 1e-300)))


def static_holds(recording: Recording) -> list[StaticHold]:
    """Return the holds of a staircase with measured effort: by the events of a bag, or where the joint stands still."""
    spans = _event_spans(recording) or _still_spans(recording)
    holds: list[StaticHold] = []
    for start, stop in spans:
        # The first third of a hold still carries the motion before it.
        inside = (recording.time >= start + (stop - start) / 3.0) & (recording.time <= stop)
        before = recording.position[(recording.time < start) & (recording.time > start - 1.0)]
        effort = np.interp(recording.time[inside], recording.input_stamps, recording.input)
        if inside.sum() < 3:
            continue
        position = float(recording.position[inside].mean())
        last = holds[-1].position if holds else (float(before[0]) if before.size else position)
        holds.append(StaticHold(position, float(effort.mean()), float(start), float(stop), abs(position) > abs(last)))
    return holds


def fit_gravity(recordings: Sequence[Recording]) -> ThesisResult:
    """Regress the mean effort of static holds on sin(theta), trial by trial (experiment 2).

    Raises:
        DataError: where a recording has fewer than four holds.
    """
    trials, loops = [], []
    for recording in map(trial_part, recordings):
        _require_effort(recording)
        holds = static_holds(recording)
        if len(holds) < 4:
            raise DataError(f"{recording.name} has {len(holds)} static holds; expected at least 4")
        position = np.array([hold.position for hold in holds])
        effort = np.array([hold.effort for hold in holds])
        trials.append(regress(recording.name, ("gravity",), np.sin(position)[:, None], effort))
        outward = np.sign(position) * (effort - trials[-1].values[0] * np.sin(position))
        upward = np.array([hold.upward for hold in holds])
        off_centre = np.abs(position) > 0.1
        if (upward & off_centre).any() and (~upward & off_centre).any():
            loops.append(float(outward[upward & off_centre].mean() - outward[~upward & off_centre].mean()))
    average, intervals, sign = _average(trials)
    hysteresis = abs(float(np.mean(loops))) if loops else 0.0
    said = [
        (
            f"Effort going up and coming down differs by {hysteresis:.3g} N m on average: dry friction or "
            f"hysteresis of {0.5 * hysteresis:.3g} N m, which the average of both directions removes."
        )
    ]
    said += _correlated(trials)
    if sign < 0:
        said.append(
            "The coefficient was negative: the actuator reports the torque of the environment; signs are turned."
        )
    return ThesisResult("gravity", tuple(trials), average, intervals, sign, hysteresis, tuple(said))


def _require_effort(recording: Recording) -> None:
    if recording.input_kind != "effort":
        raise DataError(f"{recording.name} has the input {recording.input_kind!r}; the regressions need an effort")
    if recording.input_time is not None and recording.meta.get("effort") == "applied":
        raise DataError(f"{recording.name} was read with applied effort; the regressions need the measured one")


def _average(trials: Sequence[Regression]) -> tuple[dict[str, float], dict[str, tuple[float, float]], int]:
    if not trials:
        raise DataError("there is no recording to regress; expected at least one")
    values = np.array([r.values for r in trials])
    sign = -1 if values[:, 0].mean() < 0.0 else 1
    average, intervals = {}, {}
    for i, name in enumerate(trials[0].names):
        column = sign * values[:, i]
        average[name] = float(column.mean())
        inside = float(np.sqrt(np.sum([r.errors[i] ** 2 for r in trials])) / len(trials))
        # One trial has its own degrees of freedom, the error of several is as good as normal.
        half = 1.96 * inside if len(trials) > 1 else 0.5 * float(np.ptp(trials[0].intervals[i]))
        if len(trials) > 1:
            # The trials' scatter sees what a regression's own error does not: correlated residuals, other hands.
            scatter = float(column.std(ddof=1) / np.sqrt(len(trials)))
            half = max(half, float(student_quantile(0.975, len(trials) - 1)) * scatter)
        intervals[name] = (average[name] - half, average[name] + half)
    return average, intervals, sign


def _correlated(trials: Sequence[Regression]) -> list[str]:
    """Return what the intervals allow for beside independent residuals, and what one trial cannot show."""
    said = []
    factor = float(np.max([r.inflation for r in trials]))
    if factor > _CORRELATED:
        said.append(
            f"Residuals are correlated in time (hysteresis, friction, a hand): errors are up to {factor:.2g} times "
            "those of independent ones, which the full tables print."
        )
    if len(trials) == 1:
        said.append(
            "One trial does not show how much trials differ: expected three or more for an interval to rely on."
        )
    return said


def _share(regression: Regression) -> float:
    viscous = regression.values[0] * regression.regressors[:, 0]
    inertial = regression.values[1] * regression.regressors[:, 1]
    return float(np.sqrt(np.mean(inertial**2) / max(np.mean(viscous**2), 1e-300)))


def trial_part(recording: Recording) -> Recording:
    """Return what lies between the events ``trial_start`` and ``trial_end``; all of it without such events."""
    times = {name: time for time, name, _ in recording.meta.get("phases") or [] if name in _TRIAL_EVENTS}
    start = times.get(Event.TRIAL_START, float(recording.time[0]))
    stop = times.get(Event.TRIAL_END, float(recording.time[-1]) + 1.0)
    return recording.between(start, stop) if times else recording


def _event_spans(recording: Recording) -> list[tuple[float, float]]:
    known = {*_HOLD_EVENTS, *_TRIAL_EVENTS, "dynamic"}
    phases = [phase for phase in recording.meta.get("phases") or [] if phase[1] in known]
    ends = [time for time, _, _ in phases[1:]] + [float(recording.time[-1])]
    spans = []
    for (time, name, _), following in zip(phases, ends[: len(phases)], strict=True):
        if name in _HOLD_EVENTS and following > time:
            spans.append((float(time), float(following)))
    return spans


def _still_spans(recording: Recording) -> list[tuple[float, float]]:
    count = max(3, round(0.1 / recording.period))
    smooth = np.convolve(np.pad(recording.position, count, mode="edge"), np.ones(count) / count, mode="same")
    velocity = np.gradient(smooth[count:-count], recording.time)
    still = np.concatenate(([0], (np.abs(velocity) < _STILL).astype(int), [0]))
    edges = np.flatnonzero(np.diff(still))
    time = recording.time
    spans = [(float(time[a]), float(time[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(a, b) for a, b in spans if b - a >= _SHORTEST_HOLD]
