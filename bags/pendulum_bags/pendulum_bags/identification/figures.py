"""Figures of an identification and of the thesis's regressions, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from pendulum_bags.identification.problem import simulate
from pendulum_bags.identification.thesis import ThesisResult, static_holds, trial_part
from pendulum_bags.runs.datasets import Recording

if TYPE_CHECKING:
    from pendulum_bags.identification.result import IdentificationResult

__all__ = ["fit_figures", "save", "thesis_figures"]

MEASURED, SIMULATED = "#444444", "#c2410c"


def fit_figures(result: IdentificationResult) -> dict[str, Figure]:
    """Return the figures of an output-error fit: by recording, residual tests, friction models."""
    figures: dict[str, Figure] = {}
    for i, (piece, state) in enumerate(zip(result.fit.pieces, result.fit.chosen.solution.states, strict=True)):
        recording = piece.recording
        simulated = simulate(result.model, piece, state)
        figure = Figure(figsize=(9.0, 5.2), layout="constrained")
        top, middle, low = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1.5))
        top.plot(recording.time, recording.position, color=MEASURED, linewidth=1.0, label="measured")
        # NaN before each window breaks the line where the simulation starts anew.
        theta = simulated.theta.copy()
        theta[piece.windows[1:, 0]] = np.nan
        top.plot(recording.time, theta, color=SIMULATED, linewidth=0.9, label="simulated")
        top.set_ylabel("angle [rad]")
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        top.set_title(recording.name)
        middle.plot(recording.time, 1e3 * (simulated.theta - recording.position), color=SIMULATED, linewidth=0.7)
        middle.axhline(0.0, color="black", linewidth=0.5)
        middle.set_ylabel("residual [mrad]")
        low.plot(recording.input_stamps, recording.input, color=MEASURED, linewidth=0.7)
        low.set_ylabel({"effort": "effort [N m]", "voltage": "input [V]"}.get(recording.input_kind, "input"))
        low.set_xlabel("time [s]")
        figures[f"fit_{i + 1}"] = figure
    figures["residuals"] = _residual_figure(result)
    figures["friction_models"] = _candidate_figure(result)
    return figures


def _residual_figure(result: IdentificationResult) -> Figure:
    tests = result.tests
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.stem(np.arange(len(tests.autocorrelation)), tests.autocorrelation, basefmt=" ")
    left.set_xlabel("lag [samples]")
    left.set_ylabel("autocorrelation of the residual")
    half = len(tests.cross_correlation) // 2
    right.stem(np.arange(-half, half + 1), tests.cross_correlation, basefmt=" ")
    right.set_xlabel("lag [samples], positive: the input leads")
    right.set_ylabel("correlation with the input")
    for axes in (left, right):
        axes.axhspan(-tests.bound, tests.bound, color="#94a3b8", alpha=0.4, linewidth=0.0)
    return figure


def _candidate_figure(result: IdentificationResult) -> Figure:
    figure = Figure(figsize=(9.0, 2.6), layout="constrained")
    axes = figure.subplots()
    names = [c.friction for c in result.fit.candidates]
    place = np.arange(len(names))
    axes.bar(
        place - 0.2,
        [1e3 * c.training_rms for c in result.fit.candidates],
        0.4,
        color=MEASURED,
        label="training",
    )
    axes.bar(place + 0.2, [1e3 * c.score for c in result.fit.candidates], 0.4, color=SIMULATED, label="held out")
    axes.set_xticks(place, [f"{n} (chosen)" if n == result.fit.chosen.friction else n for n in names])
    axes.set_ylabel("angle rms [mrad]")
    axes.legend()
    return figure


def thesis_figures(result: ThesisResult, recordings: Sequence[Recording]) -> dict[str, Figure]:
    """Return the thesis's figures of experiment 1 (trials) or 2 (dynamic phase, static phase, fit over the sine)."""
    recordings = [trial_part(recording) for recording in recordings]
    if result.kind == "inertia_damping":
        return _inertia_damping_figures(result, recordings)
    return _gravity_figures(result, recordings)


def _inertia_damping_figures(result: ThesisResult, recordings: Sequence[Recording]) -> dict[str, Figure]:
    figures = {}
    for kind, column, label in (
        ("velocity", 0, "velocity [rad/s]"),
        ("acceleration", 1, "acceleration [rad/s^2]"),
    ):
        figure, panels = _grid(len(result.trials))
        for axes, trial in zip(panels, result.trials, strict=False):
            axes.plot(trial.regressors[:, column], trial.response, ".", markersize=2, color=MEASURED)
            ends = np.array([trial.regressors[:, column].min(), trial.regressors[:, column].max()])
            axes.plot(ends, trial.values[column] * ends, color=SIMULATED, linewidth=1.0)
            axes.set_title(trial.trial, fontsize=8)
            axes.set_xlabel(label)
            axes.set_ylabel("effort [N m]")
        figures[f"effort_over_{kind}"] = figure
    figure, panels = _grid(len(result.trials))
    for axes, trial, recording in zip(panels, result.trials, recordings, strict=False):
        axes.plot(recording.time, trial.response, color=MEASURED, linewidth=0.8, label="measured")
        fitted = trial.regressors @ trial.values
        axes.plot(recording.time, fitted, color=SIMULATED, linewidth=0.8, label="fitted")
        axes.set_title(trial.trial, fontsize=8)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("effort [N m]")
    panels[0].legend(fontsize=7)
    figures["trials"] = figure
    return figures


def _gravity_figures(result: ThesisResult, recordings: Sequence[Recording]) -> dict[str, Figure]:
    figures = {}
    dynamic = Figure(figsize=(9.0, 5.0), layout="constrained")
    panels = dynamic.subplots(3, 1, sharex=True)
    for recording in recordings:
        panels[0].plot(recording.time, recording.position, linewidth=0.8, label=recording.name)
        if recording.velocity is not None:
            panels[1].plot(recording.time, recording.velocity, linewidth=0.6)
        panels[2].plot(recording.input_stamps, recording.input, linewidth=0.6)
    for axes, label in zip(panels, ("angle [rad]", "velocity [rad/s]", "effort [N m]"), strict=True):
        axes.set_ylabel(label)
    panels[2].set_xlabel("time [s]")
    panels[0].legend(fontsize=7)
    figures["dynamic_phase"] = dynamic

    static = Figure(figsize=(9.0, 3.2), layout="constrained")
    chosen = static.subplots(1, 3)
    for axes, degrees in zip(chosen, (10.0, 90.0, -10.0), strict=True):
        for recording in recordings:
            holds = static_holds(recording)
            nearest = sorted(holds, key=lambda h: abs(np.degrees(h.position) - degrees))[:2]
            for hold in nearest:
                inside = (recording.input_stamps >= hold.start) & (recording.input_stamps <= hold.stop)
                style = "-" if hold.upward else "--"
                axes.plot(recording.input_stamps[inside] - hold.start, recording.input[inside], style, linewidth=0.7)
        axes.set_title(f"hold at {degrees:.0f} deg (dashed: coming down)", fontsize=8)
        axes.set_xlabel("time in the hold [s]")
    chosen[0].set_ylabel("effort [N m]")
    figures["static_phase"] = static

    sine = Figure(figsize=(6.5, 4.0), layout="constrained")
    axes = sine.subplots()
    for trial in result.trials:
        axes.plot(trial.regressors[:, 0], trial.response, ".", label=trial.trial)
    ends = np.array([-1.0, 1.0])
    axes.plot(ends, result.sign * result.average["gravity"] * ends, color=SIMULATED, label="average fit")
    axes.set_xlabel("sin(angle)")
    axes.set_ylabel("mean effort of a hold [N m]")
    axes.legend(fontsize=7)
    figures["effort_over_sine"] = sine
    return figures


def _grid(count: int) -> tuple[Figure, list]:  # type: ignore[type-arg]
    columns = min(3, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.2 * columns + 0.4, 2.6 * rows), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def save(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures as PNG files and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        paths.append(path)
    return paths
