"""One table of metrics of a control episode: a new metric is one function and one line in ``METRICS``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.runs.series import Series
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.json_values import without_nan

__all__ = ["METRICS", "Episode", "Metric", "episode_of", "metrics_of", "summarise_metrics"]

BAND = 0.02
"""Share of the step that still counts as settled."""
CHANGE_TIME = 0.02
"""Time over which changes of the torque are counted: two periods of the slowest plant [s]."""


@dataclass(frozen=True)
class Episode:
    """What a controller did in one run.

    Args:
        t: Time since the start, shape (n,) [s].
        error: Angle minus set-point, shape (n,) [rad].
        velocity: Shape (n,) [rad/s].
        effort: Torque of the controller, shape (n,) [N m].
        step: Angle at the start minus set-point [rad]; 0 for regulation.
    """

    t: Array
    error: Array
    velocity: Array
    effort: Array
    step: float = 0.0


def episode_of(series: Series, set_point: float = UPRIGHT) -> Episode:
    """Return the episode of a motion that is to stay at the set-point."""
    return Episode(series.t - series.t[0], series.position - set_point, series.velocity, series.effort)


def _integral(episode: Episode, values: Array) -> float:
    return float(0.5 * (values[1:] + values[:-1]) @ np.diff(episode.t))


def _overshoot(episode: Episode) -> float:
    if episode.step == 0.0:
        return float("nan")
    return float(max(0.0, np.max(-episode.error / episode.step)))


def _rise_time(episode: Episode) -> float:
    """Time from 10 to 90 per cent of the step."""
    if episode.step == 0.0:
        return float("nan")
    done = 1.0 - episode.error / episode.step
    reached = [np.flatnonzero(done >= share) for share in (0.1, 0.9)]
    if not all(index.size for index in reached):
        return float("inf")
    return float(episode.t[reached[1][0]] - episode.t[reached[0][0]])


def _settling_time(episode: Episode) -> float:
    """Time after which the error stays within 2 per cent of the step."""
    if episode.step == 0.0:
        return float("nan")
    outside = np.flatnonzero(np.abs(episode.error) > BAND * abs(episode.step))
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    return float(episode.t[last + 1]) if last + 1 < episode.t.size else float("inf")


def _smoothness(episode: Episode) -> float:
    """Root mean square change of the torque within ``CHANGE_TIME``, per that time; NaN for slower samples."""
    t = episode.t
    if float(np.median(np.diff(t))) > CHANGE_TIME * (1.0 + 1e-6):
        return float("nan")
    first = t[t <= t[-1] - CHANGE_TIME + 1e-9]
    if not first.size:
        return float("nan")
    # Half a microsecond later: rounding of stamps must not pick the sample before.
    index = np.searchsorted(t, first + CHANGE_TIME + 5e-7, side="right") - 1
    return rms(episode.effort[index] - episode.effort[: first.size]) / CHANGE_TIME


class Metric(NamedTuple):
    """A metric: its name, unit, meaning and function; NaN where an episode has no such thing."""

    name: str
    unit: str
    meaning: str
    function: Callable[[Episode], float]


METRICS: tuple[Metric, ...] = (
    Metric("overshoot", "-", "largest excursion beyond the set-point per step", _overshoot),
    Metric("rise_time", "s", "time from 10 to 90 % of the step", _rise_time),
    Metric("settling_time", "s", "time after which the error stays within 2 % of the step", _settling_time),
    Metric(
        "steady_state_error",
        "rad",
        "mean error over the last tenth",
        lambda e: e.error[-max(1, e.error.size // 10) :].mean(),
    ),
    Metric("rms_error", "rad", "root mean square error", lambda e: rms(e.error)),
    Metric("rms_velocity", "rad/s", "root mean square velocity", lambda e: rms(e.velocity)),
    Metric("ise", "rad^2 s", "integral of squared error", lambda e: _integral(e, e.error**2)),
    Metric("iae", "rad s", "integral of absolute error", lambda e: _integral(e, np.abs(e.error))),
    Metric("itae", "rad s^2", "integral of time times absolute error", lambda e: _integral(e, e.t * np.abs(e.error))),
    Metric("max_effort", "N m", "largest absolute torque", lambda e: np.max(np.abs(e.effort))),
    Metric("rms_effort", "N m", "root mean square torque", lambda e: rms(e.effort)),
    # What the winding pays in heat, up to a constant of the motor.
    Metric("effort_energy", "N^2 m^2 s", "integral of squared torque", lambda e: _integral(e, e.effort**2)),
    # Positive where the controller's torque drives, negative where it brakes.
    Metric("work", "J", "mechanical work of the torque", lambda e: _integral(e, e.effort * e.velocity)),
    Metric(
        "absolute_work",
        "J",
        "integral of absolute mechanical power",
        lambda e: _integral(e, np.abs(e.effort * e.velocity)),
    ),
    Metric("smoothness", "N m/s", "root mean square change of the torque within 20 ms, per that time", _smoothness),
)


def metrics_of(episode: Episode) -> dict[str, float]:
    """Return every metric of ``METRICS`` that the episode has, by name."""
    values = {metric.name: float(metric.function(episode)) for metric in METRICS}
    return {name: value for name, value in values.items() if not np.isnan(value)}


def summarise_metrics(episodes: Mapping[str, Episode]) -> list[dict[str, float | str | None]]:
    """Return one row for each metric, with a column for each episode; for tables and JSON."""
    values = {name: metrics_of(episode) for name, episode in episodes.items()}
    rows: list[dict[str, float | str | None]] = []
    for metric in METRICS:
        if any(metric.name in found for found in values.values()):
            row = {"metric": metric.name, "unit": metric.unit, "meaning": metric.meaning}
            rows.append({**row, **{name: without_nan(found.get(metric.name)) for name, found in values.items()}})
    return rows
