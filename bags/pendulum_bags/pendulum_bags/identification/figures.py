"""Figures of an identification, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from pendulum_bags.identification.problem import simulate

if TYPE_CHECKING:
    from pendulum_bags.identification.result import IdentificationResult

__all__ = ["fit_figures", "save"]

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


def save(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures as PNG files and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        paths.append(path)
    return paths
