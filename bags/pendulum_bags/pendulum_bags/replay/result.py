"""What a replay gives: errors over windows, horizons and the free run."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.identification.explained import LARGEST_SHARE
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["HorizonError", "InputReplay", "fit_percent", "horizon_errors"]

MOST_STARTS = 60
"""Starts of k-step predictions: enough for a smooth curve, spread over the recording."""
DIVERGED = 0.1
"""Share of the measured range beyond which a free run counts as diverged."""


@dataclass(frozen=True)
class HorizonError:
    """Error of predictions from measured states: rms angle at the end of a horizon [rad], over a number of starts."""

    steps: int
    time: float
    rms: float
    starts: int


@dataclass(frozen=True)
class InputReplay:
    """A plant driven by a recorded input, and the measurement.

    Args:
        name: Name of the recording.
        plant: Parameters of the model.
        window: Length of the windows [s].
        rms: Angle error over windows whose initial states are fitted [rad].
        lines: Error of the best straight line through each window [rad]; NaN where the start is not fitted.
        by_window: The same of each window, shape (w,) [rad].
        window_time, window_angle: Simulated angle in windows, shape (n,) [s], [rad].
        time, measured, free_run: Measured angle, and simulated from the first state alone, shape (n,) [s], [rad].
        horizons: Errors of predictions over growing horizons.
        driven_by: What drove the plant, as text.
    """

    name: str
    plant: PlantParameters
    window: float
    rms: float
    lines: float
    by_window: Array
    window_time: Array
    window_angle: Array
    time: Array
    measured: Array
    free_run: Array
    horizons: tuple[HorizonError, ...]
    driven_by: str = "the measured torque"

    @property
    def free_run_rms(self) -> float:
        """Angle error of the free run [rad]."""
        return rms(self.free_run - self.measured)

    @property
    def fit(self) -> float:
        """Fit of the free run [%]: 100 is perfect, 0 is as good as the mean."""
        return fit_percent(self.measured, self.free_run)

    @property
    def threshold(self) -> float:
        """Angle error from which a free run counts as diverged [rad]."""
        return DIVERGED * float(np.ptp(self.measured))

    @property
    def diverges_at(self) -> float | None:
        """Time at which the free run first errs by more than that [s]; None if never."""
        beyond = np.flatnonzero(np.abs(self.free_run - self.measured) > self.threshold)
        return float(self.time[beyond[0]] - self.time[0]) if beyond.size else None

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return {
            "recording": self.name,
            "plant": self.plant.name,
            "window_s": self.window,
            "rms_rad": self.rms,
            "rms_by_window_rad": self.by_window.tolist(),
            "free_run_rms_rad": self.free_run_rms,
            "free_run_fit_percent": self.fit,
            "diverges_at_s": self.diverges_at,
            "divergence_threshold_rad": self.threshold,
            "one_step_rms_rad": self.horizons[0].rms if self.horizons else None,
            "horizons": [
                {"steps": one.steps, "time_s": one.time, "rms_rad": one.rms, "starts": one.starts}
                for one in self.horizons
            ],
        }

    @property
    def objection(self) -> str | None:
        """That the plant does not describe this motion, in a sentence; None where it may."""
        share = self.rms / self.lines
        if not (share > LARGEST_SHARE or (share > DOUBTFUL_SHARE and self.fit < 0.0)):
            return None
        return (
            f"The plant {self.plant.name!r} does not describe {self.name}: it misses {100.0 * share:.0f} % of what "
            f"straight lines through windows of {self.window:g} s miss, and its free run has a fit of {self.fit:.0f} % "
            "(0 is the mean of the motion). It is the plant of another machine, or lacks what moves this one."
        )

    def sentence(self) -> str:
        """Return the result as text."""
        where = "never" if self.diverges_at is None else f"after {self.diverges_at:.2f} s"
        best, worst = self.by_window.min(), self.by_window.max()
        return (
            f"Driven by {self.driven_by} of {self.name}, the plant {self.plant.name!r} errs by {self.rms:.4f} rad "
            f"rms over windows of {self.window:g} s (best {best:.4f}, worst {worst:.4f}); in free run by "
            f"{self.free_run_rms:.4f} rad (fit {self.fit:.1f} %), and it departs by more than "
            f"{self.threshold:.2f} rad {where}."
        )

    def figure(self) -> Figure:
        """Return measured and simulated angle in one figure, and the error of the windows."""
        error = self.window_angle - np.interp(self.window_time, self.time, self.measured)
        time = "time [s]"
        panels = [
            Panel(
                time,
                "θ [rad]",
                [
                    Trace(self.time, self.measured, "measured", "difference"),
                    Trace(self.window_time, self.window_angle, f"simulated, {self.window:g} s windows", "hw"),
                    Trace(self.time, self.free_run, "simulated, free run", "own"),
                ],
            ),
            Panel(time, "error in windows [rad]", [Trace(self.window_time, error, "", "difference")]),
        ]
        title = f"Replay of a real pendulum: {self.name}"
        return Figure("replay", title, self.sentence(), panels, section="A real pendulum", panel_height=220)


def fit_percent(measured: Array, simulated: Array) -> float:
    """Return 100 (1 - |y - y_hat| / |y - mean(y)|) [%]. Source: Ljung, System Identification, 1999, section 16.4."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(measured - simulated)) / spread) if spread > 0.0 else math.nan


def horizon_errors(
    size: int, period: float, longest: float, error_from: Callable[[int, int], Array]
) -> tuple[HorizonError, ...]:
    """Return errors of predictions after 1, 2, 5, 10, 20, ... samples, up to the longest horizon [s].

    ``error_from`` maps the sample of a start and a number of steps to the angle errors there and after each [rad].
    """
    reach = min(max(1, round(longest / period)), size - 1)
    starts = np.unique(np.linspace(0, size - 1 - reach, MOST_STARTS).astype(int))
    error = np.stack([error_from(int(first), reach) for first in starts])
    steps = sorted({k for k in (m * 10**e for e in range(7) for m in (1, 2, 5)) if k < reach} | {reach})
    return tuple(HorizonError(k, k * period, rms(error[:, k]), starts.size) for k in steps)
