"""Input replay: drive a plant model with recorded torque and see how far it follows the measured motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from pendulum_bags.identification.window_score import window_score
from pendulum_bags.runs.datasets import Recording, read_recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.plant import Plant
from pendulum_sim.plants import make_plant

if TYPE_CHECKING:
    from pendulum_bags.figures.figure import Figure

__all__ = ["HorizonError", "InputReplay", "fit_percent", "horizon_steps", "replay_input", "replay_recording"]

Array = NDArray[np.float64]

SMOOTHING = 0.02
"""Half width of the parabola that gives the measured state at a sample [s]: quantised angles have no velocity."""
MOST_STARTS = 60
"""Starts of k-step predictions: enough for a smooth curve, spread over the recording."""
DIVERGED = 0.1
"""Share of the measured range beyond which a free run counts as diverged."""


@dataclass(frozen=True)
class HorizonError:
    """Error of predictions over a horizon, from measured states.

    Args:
        steps: Horizon in samples, 1 for one-step.
        time: The same [s].
        rms: Root mean square angle error at its end [rad].
        starts: Number of predictions.
    """

    steps: int
    time: float
    rms: float
    starts: int


@dataclass(frozen=True)
class InputReplay:
    """A plant driven by a recorded input, beside what was measured.

    Args:
        name: Name of the recording.
        plant: Parameters of the model.
        window: Length of the windows [s].
        rms: Angle error over windows whose initial states are fitted [rad].
        by_window: The same of each window, shape (w,) [rad].
        window_time, window_angle: Simulated angle in windows, shape (n,) [s], [rad].
        time, measured, free_run: Measured angle, and simulated from the first state alone, shape (n,) [s], [rad].
        free_run_rms: Angle error of the free run [rad].
        fit: Fit of the free run [%]: 100 is perfect, 0 is as good as the mean.
        diverges_at: Time at which the free run first errs by a tenth of the measured range [s]; None if never.
        threshold: That tenth [rad].
        horizons: Errors of predictions over growing horizons.
        from_fitted_state: Whether windows and free run start from fitted states rather than smoothed measured ones.
        driven_by: What drove the plant, in words.
    """

    name: str
    plant: PlantParameters
    window: float
    rms: float
    by_window: Array
    window_time: Array
    window_angle: Array
    time: Array
    measured: Array
    free_run: Array
    free_run_rms: float
    fit: float
    diverges_at: float | None
    threshold: float
    horizons: tuple[HorizonError, ...]
    from_fitted_state: bool
    driven_by: str = "the measured torque"

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

    def sentence(self) -> str:
        """Return the result in words."""
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
        from pendulum_bags.figures.figure import Figure, Panel, Trace

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


def replay_recording(
    path: str | Path,
    plant: str | Path | PlantParameters,
    *,
    window: float = 1.0,
    mapping: str | Path | None = None,
    hold: str | None = None,
    effort: str = "applied",
    start: float | None = None,
    stop: float | None = None,
    namespace: str | None = None,
) -> InputReplay:
    """Read a recording (CSV or bag) and drive a plant with its torque.

    Args:
        path: Recording, as for :func:`pendulum_bags.runs.datasets.read_recording`.
        plant: Plant file, preset or parameters.
        window: Length of the windows [s].
        mapping: Mapping file of a CSV.
        hold: Of the input of a CSV, ``zero`` or ``linear``; by default what its mapping says.
        effort: For bags, ``applied`` or ``measured`` torque.
        start: Leave out what comes before, from the beginning of the recording [s].
        stop: Leave out what comes after [s].
        namespace: For bags with several plants, such as ``/sim``.

    A voltage, a set point or a free swing drives the fit that identification left beside the plant file.

    Raises:
        DataError: The recording is damaged, or nothing here takes its input.
        ParameterError: The plant file is refused.
    """
    recording = read_recording(path, mapping, effort=effort, namespace=namespace, hold=hold)
    if start is not None or stop is not None:
        begin = float(recording.time[0])
        last = math.inf if stop is None else begin + stop
        recording = recording.between(begin + (start or 0.0), last)
    if recording.input_kind != "effort" or (isinstance(plant, str | Path) and Path(plant).suffix == ".json"):
        from pendulum_bags.replay.fit_replay import replay_fit

        return replay_fit(recording, plant, window=window)
    parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
    return replay_input(recording, parameters, window=window)


def replay_input(recording: Recording, parameters: PlantParameters, *, window: float = 1.0) -> InputReplay:
    """Drive a plant with the torque of a recording.

    Windows of a rigid plant have fitted initial states, by the same score that identification minimises; those of a
    series-elastic plant start from smoothed measured states, for its motor's state is not measured.

    Args:
        recording: Data with torque input.
        parameters: The plant.
        window: Length of the windows [s], > 0.

    Raises:
        DataError: The input is no torque.
    """
    if recording.input_kind != "effort":
        raise DataError(
            f"{recording.name} has the input {recording.input_kind!r}; expected 'effort' [N m] to drive a plant"
        )
    if not window > 0.0:
        raise DataError(f"window is {window} s; expected > 0")
    driven = _Driven.of(recording, parameters)
    if parameters.drivetrain is None:
        score = window_score(parameters, recording, window)
        rms, by_window = score.rms, score.by_window
        window_time, window_angle = score.time, score.simulated
        start = tuple(score.states[0])
    else:
        window_time, window_angle, by_window = _windows(driven, window)
        rms = float(
            np.sqrt(np.mean((window_angle - np.interp(window_time, driven.time, driven.position)) ** 2))
        )
        start = (float(driven.position[0]), float(driven.velocity[0]))
    free = driven.run(0, driven.time.size - 1, (float(start[0]), float(start[1])))
    error = free - driven.position
    threshold = DIVERGED * float(np.ptp(driven.position))
    beyond = np.flatnonzero(np.abs(error) > threshold)
    return InputReplay(
        name=recording.name,
        plant=parameters,
        window=window,
        rms=float(rms),
        by_window=by_window,
        window_time=window_time,
        window_angle=window_angle,
        time=driven.time,
        measured=driven.position,
        free_run=free,
        free_run_rms=float(np.sqrt(np.mean(error**2))),
        fit=fit_percent(driven.position, free),
        diverges_at=float(driven.time[beyond[0]] - driven.time[0]) if beyond.size else None,
        threshold=threshold,
        horizons=_horizons(driven, window),
        from_fitted_state=parameters.drivetrain is None,
    )


def fit_percent(measured: Array, simulated: Array) -> float:
    """Return 100 (1 - |y - y_hat| / |y - mean(y)|) [%]. Source: Ljung, System Identification, 1999, section 16.4."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(measured - simulated)) / spread) if spread > 0.0 else math.nan


@dataclass(frozen=True)
class _Driven:
    """A recording at a fixed period, and a plant that can be run along it.

    Args:
        time: Uniform times, shape (n,) [s].
        position: Measured angle, shape (n,) [rad].
        velocity: Slope of a parabola through the neighbouring angles, shape (n,) [rad/s].
        torque: Mean torque from each time to the next, shape (n - 1,) [N m].
        plant: The model.
    """

    time: Array
    position: Array
    velocity: Array
    smooth: Array
    torque: Array
    plant: Plant

    @classmethod
    def of(cls, recording: Recording, parameters: PlantParameters) -> _Driven:
        period = recording.period
        count = math.floor(recording.duration / period + 1e-6) + 1
        time = recording.time[0] + period * np.arange(count)
        position = np.interp(time, recording.time, recording.position)
        reach = min(max(2, round(SMOOTHING / period)), (count - 1) // 2)
        width = 2 * reach + 1
        smooth = savgol_filter(position, width, 2)
        velocity = savgol_filter(position, width, 2, deriv=1, delta=period)
        torque = _mean_input(recording, time)
        # Measured torque was applied, whatever the model's actuator could give.
        limit = max(parameters.effort_limit, 1.001 * float(np.abs(torque).max()))
        plant = make_plant(parameters.with_values(effort_limit=limit), period)
        return cls(time, position, velocity, smooth, torque, plant)

    def run(self, first: int, steps: int, state: tuple[float, float] | None = None) -> Array:
        """Return the angle at the samples ``first`` to ``first + steps``, starting there from the measured state."""
        start = (float(self.smooth[first]), float(self.velocity[first])) if state is None else state
        plant = self.plant
        plant.reset(*start)
        angle = np.empty(steps + 1)
        angle[0] = start[0]
        for i, torque in enumerate(self.torque[first : first + steps].tolist(), start=1):
            angle[i] = plant.step(torque).theta
        return angle


def _mean_input(recording: Recording, time: Array) -> Array:
    """Return the mean of the input over each interval, which is what a held torque must be to push as much."""
    stamps, values = recording.input_stamps, recording.input
    if recording.hold == "linear":
        at = np.interp(time, stamps, values)
        return np.asarray(0.5 * (at[1:] + at[:-1]))
    # A held input has a piecewise linear integral, so interpolating that is exact.
    edges = np.append(stamps, max(float(time[-1]), float(stamps[-1])) + 1.0)
    integral = np.concatenate(([0.0], np.cumsum(values * np.diff(edges))))
    return np.asarray(np.diff(np.interp(time, edges, integral)) / np.diff(time))


def _windows(driven: _Driven, window: float) -> tuple[Array, Array, Array]:
    period = float(driven.time[1] - driven.time[0])
    length = max(2, round(window / period))
    times, angles, errors = [], [], []
    for first in range(0, driven.time.size - length + 1, length):
        angle = driven.run(first, length - 1)
        part = slice(first, first + length)
        times.append(driven.time[part])
        angles.append(angle)
        errors.append(float(np.sqrt(np.mean((angle - driven.position[part]) ** 2))))
    if not times:
        angle = driven.run(0, driven.time.size - 1)
        return driven.time, angle, np.array([float(np.sqrt(np.mean((angle - driven.position) ** 2)))])
    return np.concatenate(times), np.concatenate(angles), np.array(errors)


def _horizons(driven: _Driven, longest: float) -> tuple[HorizonError, ...]:
    """Return errors after 1, 2, 5, 10, ... samples, up to the longest horizon."""
    period = float(driven.time[1] - driven.time[0])
    reach = min(max(1, round(longest / period)), driven.time.size - 1)
    starts = np.unique(np.linspace(0, driven.time.size - 1 - reach, MOST_STARTS).astype(int))
    error = np.stack(
        [driven.run(int(first), reach) - driven.position[first : first + reach + 1] for first in starts]
    )
    return tuple(
        HorizonError(k, k * period, float(np.sqrt(np.mean(error[:, k] ** 2))), starts.size)
        for k in horizon_steps(reach)
    )


def horizon_steps(reach: int) -> list[int]:
    """Return 1, 2, 5, 10, 20, ... samples up to the longest horizon."""
    return sorted({k for k in (m * 10**e for e in range(7) for m in (1, 2, 5)) if k < reach} | {reach})
